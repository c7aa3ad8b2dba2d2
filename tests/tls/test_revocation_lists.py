"""Revocation lists of every form: the listener and the HTTP services judge alike by them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization

from holdfast.cli import main
from holdfast.cli.configuration import load_whole
from holdfast.config import ConfigError
from holdfast.events import log_lines
from holdfast.events.throttle import Throttle
from holdfast.net.certificates.inspection import describe
from support import wire
from support.certificates import LISTS, PAST, Certificates, named
from support.config_folder import written
from support.tls_peer import context, rest_verdict, verdict

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.certificates import Issued
    from support.running import Run

FORMS: dict[str, tuple[Sequence[str], str | None]] = {
    "version 1": ((), None),
    "version 2 without extensions": ((), "keyCompromise"),
    "no CRL number": (["authority key identifier"], None),
    "no authority key identifier": (["CRL number"], "superseded"),
    "complete": (tuple(LISTS), None),
}
"""What lists of each form have, and the reason of the entries."""


class Plant:
    """An authority whose lists have some form, and what it has issued."""

    def __init__(self, folder: Path, lists_have: Sequence[str] = (), name: str = "plant") -> None:
        folder.mkdir(exist_ok=True)
        self.folder = folder
        self.authority = Certificates(folder, name, lists_have)
        self.server = self.authority.issue("server", "DNS:localhost,IP:127.0.0.1")

    def client(self, name: str) -> Issued:
        return self.authority.issue(name, f"DNS:{name}", extensions=[named("a")])

    def config(self, crl_file: Path, *, https: bool = True) -> Path:
        """An appliance whose listener and REST API have the same files."""
        own = {"cert_file": str(self.server.certificate), "key_file": str(self.server.key)}
        ca, lists = str(self.authority.ca), str(crl_file)
        secure = {
            "type": "modbus-tls",
            "bind": "127.0.0.1:0",
            "tls": {**own, "ca_file": ca, "crl_file": lists},
            "rules": [{"sources": ["127.0.0.1"], "access": "read-only", "units": {1: "plant"}}],
        }
        rest = {
            "bind": "127.0.0.1:0",
            "sources": ["127.0.0.0/8"],
            "tokens": "none",
            "tls": {**own, "client_ca_file": ca, "crl_file": lists},
        }
        whole: dict[str, Any] = {
            "memories": {"plant": {"holding_registers": 8}},
            "listeners": {"secure": secure},
        }
        file = self.folder / "plant.yaml"
        file.write_text(written({**whole, "rest": rest} if https else whole))
        return file

    def judged(self, appliance: Appliance, client: Issued) -> tuple[str, str]:
        """What the listener and the REST API say to a client: `served`, or the reason they log."""
        trust = context(self.authority.ca, client)

        def failed() -> dict[str, int]:
            counted: Any = appliance.diagnostics.stats()["listeners"]["secure"]
            return dict(counted.get("tls_failures", {}))

        before = failed()
        by_listener = verdict(appliance, trust)
        if by_listener != "served":
            wire.until(lambda: failed() != before, "the failure is counted")
            [by_listener] = [key for key, n in failed().items() if n != before.get(key, 0)]
        return by_listener, rest_verdict(appliance, trust)


@pytest.fixture(autouse=True)
def every_refusal_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle())


@pytest.mark.parametrize("form", FORMS)
def test_a_revoked_certificate_is_refused_and_others_are_served(
    form: str, tmp_path: Path, run: Run
) -> None:
    lists_have, reason = FORMS[form]
    plant = Plant(tmp_path, lists_have)
    kept, lost = plant.client("kept"), plant.client("lost")
    crl = plant.authority.revoke(lost, reason=reason)
    appliance = run(plant.config(crl).read_text())
    assert plant.judged(appliance, kept) == ("served", "served")
    assert plant.judged(appliance, lost) == ("revoked", "revoked")


@pytest.mark.parametrize("form", FORMS)
def test_a_list_of_another_authority_of_the_same_name_does_not_count(
    form: str, tmp_path: Path, run: Run
) -> None:
    plant, twin = (Plant(tmp_path / each, FORMS[form][0]) for each in ("plant", "twin"))
    appliance = run(plant.config(twin.authority.revoke()).read_text())
    told = plant.judged(appliance, plant.client("kept"))
    assert told == ("unknown_revocation", "unknown_revocation")


@pytest.mark.parametrize("form", FORMS)
def test_authorities_of_the_same_name_have_lists_of_their_own(
    form: str, tmp_path: Path, run: Run
) -> None:
    """As after a renewal with a new key."""
    plant, twin = (Plant(tmp_path / each, FORMS[form][0]) for each in ("plant", "twin"))
    kept, lost = [each.client("kept") for each in (plant, twin)], twin.client("lost")
    lists = plant.authority.revoke().read_bytes(), twin.authority.revoke(lost).read_bytes()
    authorities = [each.authority.ca.read_bytes() for each in (plant, twin)]
    plant.authority.ca.write_bytes(b"".join(authorities))
    crl = tmp_path / "both.crl"
    crl.write_bytes(b"".join(lists))
    assert not any("clients" in str(each) for each in load_whole(plant.config(crl)).warnings)
    appliance = run(plant.config(crl).read_text())
    assert [plant.judged(appliance, each) for each in kept] == [("served", "served")] * 2
    assert plant.judged(appliance, lost) == ("revoked", "revoked")
    crl.write_bytes(lists[1])
    none = "found no list of certificate 1 of ca_file (CN=plant): its clients are refused"
    assert any(none in str(each) for each in load_whole(plant.config(crl)).warnings)


@pytest.mark.parametrize("form", FORMS)
def test_a_list_that_has_expired_refuses_clients(form: str, tmp_path: Path, run: Run) -> None:
    plant = Plant(tmp_path, FORMS[form][0])
    appliance = run(plant.config(plant.authority.revoke(dates=PAST)).read_text())
    told = plant.judged(appliance, plant.client("kept"))
    assert told == ("expired_revocation_list", "expired_revocation_list")


@pytest.mark.parametrize("forms", [("version 1", "complete"), ("complete", "version 1")])
def test_the_newest_of_lists_of_different_forms_counts(
    forms: tuple[str, str], tmp_path: Path, run: Run
) -> None:
    plant = Plant(tmp_path)
    lost = plant.client("lost")
    files = []
    for form, revoked, dates in zip(forms, ([], [lost]), (PAST, None), strict=True):
        plant.authority.configure_lists(FORMS[form][0])
        files.append(plant.authority.revoke(*revoked, dates=dates).read_bytes())
    both = tmp_path / "both.crl"
    both.write_bytes(b"".join(files))
    appliance = run(plant.config(both).read_text())
    assert plant.judged(appliance, plant.client("kept")) == ("served", "served")
    assert plant.judged(appliance, lost) == ("revoked", "revoked")


MISSING = {
    "version 1": "no authority key identifier and no CRL number",
    "no CRL number": "no CRL number",
    "no authority key identifier": "no authority key identifier",
}


@pytest.mark.parametrize("form", MISSING)
def test_what_a_list_lacks_is_a_warning_with_the_name_of_the_file(
    form: str, tmp_path: Path
) -> None:
    plant = Plant(tmp_path, FORMS[form][0])
    crl = plant.authority.revoke()
    file = plant.config(crl)
    lacks = f"has {MISSING[form]} (RFC 5280, 5.2): Holdfast uses it, other programs may refuse it"
    expected = [
        f"{file}:1: listeners.secure.tls: {crl}: revocation list 1 (CN=plant) {lacks}",
        f"{file}:1: rest.tls: {crl}: revocation list 1 (CN=plant) {lacks}",
    ]
    assert [str(warning) for warning in load_whole(file).warnings] == expected
    result = CliRunner().invoke(main, ["check", str(file)])
    assert result.exit_code == 0
    assert result.stderr.splitlines() == [f"warning: {each}" for each in expected]
    [described] = describe(crl)
    assert described.advice == [f"the list {lacks}"]


def test_a_complete_list_has_no_warning(tmp_path: Path) -> None:
    plant = Plant(tmp_path, tuple(LISTS))
    assert load_whole(plant.config(plant.authority.revoke())).warnings == ()


# Lists that the listener can't use.


class Lists:
    """Builds lists that OpenSSL does not write."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        [ca] = x509.load_pem_x509_certificates(plant.authority.ca.read_bytes())
        now = datetime.now(UTC)
        self.made = x509.CertificateRevocationListBuilder(
            ca.subject, now - timedelta(days=1), now + timedelta(days=30)
        )

    def entry(self, *extensions: tuple[x509.ExtensionType, bool]) -> Lists:
        entry = x509.RevokedCertificateBuilder(7, datetime(2026, 1, 1, tzinfo=UTC))
        for extension, critical in extensions:
            entry = entry.add_extension(extension, critical=critical)
        self.made = self.made.add_revoked_certificate(entry.build())
        return self

    def extended(self, *extensions: tuple[x509.ExtensionType, bool]) -> Lists:
        for extension, critical in extensions:
            self.made = self.made.add_extension(extension, critical=critical)
        return self

    def config(self) -> Path:
        key: Any = serialization.load_pem_private_key(self.plant.authority.key.read_bytes(), None)
        crl = self.plant.folder / "odd.crl"
        signed = self.made.sign(key, hashes.SHA256())
        crl.write_bytes(signed.public_bytes(serialization.Encoding.PEM))
        return self.plant.config(crl, https=False)


UNKNOWN = x509.UnrecognizedExtension(x509.ObjectIdentifier("1.3.6.1.4.1.50316.1"), b"\x05\0")
INDIRECT = x509.IssuingDistributionPoint(
    [x509.UniformResourceIdentifier("http://lists.example")], None, False, False, None, True, False
)
OF_ANOTHER = x509.CertificateIssuer([x509.DNSName("another")])


@pytest.fixture
def lists(tmp_path: Path) -> Lists:
    return Lists(Plant(tmp_path))


def test_extensions_that_are_not_critical_do_not_matter(lists: Lists, run: Run) -> None:
    entry = lists.entry((x509.CRLReason(x509.ReasonFlags.superseded), False), (UNKNOWN, False))
    appliance = run(entry.config().read_text())
    client = lists.plant.client("kept")
    assert verdict(appliance, context(lists.plant.authority.ca, client)) == "served"


@pytest.mark.parametrize(
    ("of_entry", "of_list"),
    [
        ([(UNKNOWN, True)], []),
        ([(OF_ANOTHER, True)], []),
        ([(OF_ANOTHER, False)], []),
        ([], [(UNKNOWN, True)]),
        ([], [(x509.DeltaCRLIndicator(1), True)]),
        ([], [(INDIRECT, True)]),
    ],
    ids=[
        "entry critical",
        "entry issuer",
        "entry issuer not critical",
        "critical",
        "delta",
        "indirect",
    ],
)
def test_lists_that_say_more_than_is_understood_are_refused(
    of_entry: list[Any], of_list: list[Any], lists: Lists
) -> None:
    file = lists.entry(*of_entry).extended(*of_list).config()
    with pytest.raises(ConfigError, match="revocation list 1 can't be read: "):
        load_whole(file)
