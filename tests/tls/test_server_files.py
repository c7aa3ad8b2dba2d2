"""The files of a listener: which are refused, which are doubtful, and what clients get then."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from holdfast import _core
from holdfast.cli import main
from holdfast.cli.configuration import load_whole
from holdfast.config import ConfigError
from holdfast.server.options import STREAM_DEFAULTS
from support import wire
from support.certificate_cases import CA, NAME, SALT_OF_KEY, SIGNS, WITH_PSS, Mint
from support.certificates import FUTURE, PAST, Certificates, Issued, named
from support.tls_peer import configuration, context, reasons, verdict

if TYPE_CHECKING:
    import ssl
    from pathlib import Path

    from support.running import Run

ANYONE: list[dict[str, Any]] = [{"sources": ["127.0.0.1"], "access": "read-only"}]


class Plant:
    """A listener's certificate, a client, and the authority of both."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.authority = Certificates(folder, "plant")
        self.server = self.authority.issue("server", "DNS:localhost,IP:127.0.0.1")
        self.client = self.authority.issue("client", "DNS:client", extensions=[named("a")])

    def files(self, **more: Any) -> dict[str, Any]:
        files = {"cert_file": self.server.certificate, "key_file": self.server.key}
        return {**files, "ca_file": self.authority.ca, **more}

    def joined(self, name: str, *files: Path) -> Path:
        joined = self.folder / name
        joined.write_bytes(b"".join(file.read_bytes() for file in files))
        return joined

    def config(self, **more: Any) -> Path:
        file = self.folder / "plant.yaml"
        file.write_text(configuration(self.files(**more), ANYONE))
        return file

    def warnings(self, **more: Any) -> list[str]:
        """What `load_whole` warns about, without the names of files."""
        told = [warning.message for warning in load_whole(self.config(**more)).warnings]
        assert all(str(self.folder) in message for message in told)
        return [message.split(": ", 1)[1] for message in told]

    def trust(self) -> ssl.SSLContext:
        """The client's."""
        return context(self.authority.ca, self.client)


@pytest.fixture
def plant(tmp_path: Path) -> Plant:
    return Plant(tmp_path)


@pytest.fixture
def mint(tmp_path: Path) -> Mint:
    return Mint(tmp_path)


def test_files_as_intended_have_no_warning(plant: Plant) -> None:
    assert plant.warnings() == []
    assert plant.warnings(crl_file=plant.authority.revoke()) == []


@pytest.mark.parametrize(
    ("dates", "told"),
    [
        (PAST, r"certificate 2 \(CN=old\) expired \d+ days ago: its clients are refused"),
        (
            FUTURE,
            r"certificate 2 \(CN=old\) is not valid yet, its validity begins in \d+ days: its ",
        ),
    ],
)
def test_an_authority_outside_its_dates_is_doubtful_and_refuses_its_clients(
    plant: Plant,
    mint: Mint,
    dates: tuple[str, str],
    told: str,
    run: Run,
    caplog: pytest.LogCaptureFixture,
) -> None:
    old = mint.root(name="old", dates=dates)
    client = mint.make(by=old, name="leaf", extensions=[named("a")])
    both = plant.joined("both.pem", plant.authority.ca, old.certificate)
    [warning] = plant.warnings(ca_file=both)
    assert re.match(told, warning)

    appliance = run(plant.config(ca_file=both).read_text())
    assert verdict(appliance, plant.trust()) == "served"
    assert "ALERT" in verdict(appliance, context(plant.authority.ca, client))
    expected = "issuer_expired" if dates == PAST else "issuer_not_yet_valid"
    assert reasons(appliance, caplog) == [expected]


def test_a_certificate_of_the_server_outside_its_dates_is_doubtful(plant: Plant) -> None:
    old = plant.authority.issue("old", "DNS:localhost", dates=PAST)
    [warning] = plant.warnings(cert_file=old.certificate, key_file=old.key)
    assert warning.startswith("certificate 1 (CN=old) expired ")
    assert warning.endswith(" days ago: clients refuse this server")


def test_a_list_that_has_expired_is_doubtful_and_refuses_clients(
    plant: Plant, run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    crl = plant.authority.revoke(dates=PAST)
    [warning] = plant.warnings(crl_file=crl)
    assert warning.startswith("revocation list 1 (CN=plant) expired ")
    assert warning.endswith(" days ago: clients of that authority are refused")
    appliance = run(plant.config(crl_file=crl).read_text())
    assert verdict(appliance, plant.trust()).endswith("ALERT_CERTIFICATE_UNKNOWN")
    assert reasons(appliance, caplog) == ["expired_revocation_list"]


def test_the_newest_list_of_an_authority_counts(plant: Plant, run: Run) -> None:
    old = plant.joined("old.crl", plant.authority.revoke(dates=PAST))
    both = plant.joined("both.crl", old, plant.authority.revoke())
    appliance = run(plant.config(crl_file=both).read_text())
    assert verdict(appliance, plant.trust()) == "served"


def test_lists_of_others_and_authorities_without_a_list_are_doubtful(
    plant: Plant, tmp_path: Path, run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    other = Certificates(tmp_path, "other").revoke()
    assert plant.warnings(crl_file=other) == [
        "revocation list 1 (CN=other) is not of an authority in ca_file: it applies only to "
        "clients that send its authority",
        "found no list of certificate 1 of ca_file (CN=plant): its clients are refused",
    ]
    appliance = run(plant.config(crl_file=other).read_text())
    assert verdict(appliance, plant.trust()).endswith("ALERT_CERTIFICATE_UNKNOWN")
    assert reasons(appliance, caplog) == ["unknown_revocation"]


def test_a_list_of_an_authority_of_the_same_name_is_doubtful(
    plant: Plant, tmp_path: Path, run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "twin"
    folder.mkdir()
    twin = plant.joined("twin.crl", Certificates(folder, "plant").revoke())
    assert plant.warnings(crl_file=twin) == [
        "revocation list 1 (CN=plant) is not signed by the authority of that name in ca_file: "
        "it does not count for the clients of that authority",
        "found no list of certificate 1 of ca_file (CN=plant): its clients are refused",
    ]
    appliance = run(plant.config(crl_file=twin).read_text())
    assert verdict(appliance, plant.trust()).endswith("ALERT_CERTIFICATE_UNKNOWN")
    assert reasons(appliance, caplog) == ["unknown_revocation"]


def test_a_list_whose_signature_can_not_be_verified_is_doubtful(
    plant: Plant, run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    older = plant.joined("older.crl", plant.authority.revoke())
    newer = x509.load_pem_x509_crl(plant.authority.revoke(plant.client).read_bytes())
    der = newer.public_bytes(Encoding.DER)
    damaged = x509.load_der_x509_crl(der[:-1] + bytes([der[-1] ^ 1]))
    file = plant.folder / "damaged.crl"
    file.write_bytes(damaged.public_bytes(Encoding.PEM))
    both = plant.joined("both.crl", older, file)
    assert plant.warnings(crl_file=both) == [
        "revocation list 2 (CN=plant) has a signature that can't be verified with the key of the "
        "authority of that name in ca_file (allowed: SHA-256, SHA-384 or SHA-512): the clients of "
        "that authority are refused, unless it has signed a newer list"
    ]
    appliance = run(plant.config(crl_file=both).read_text())
    assert verdict(appliance, plant.trust()).endswith("ALERT_CERTIFICATE_UNKNOWN")
    assert reasons(appliance, caplog) == ["unknown_revocation"]


def test_a_listed_certificate_that_is_revoked_is_doubtful(plant: Plant, mint: Mint) -> None:
    root = Issued(plant.authority.ca, plant.authority.key)
    between = mint.make(by=root, name="between", extensions=(CA, SIGNS))
    crl = plant.authority.revoke(between, plant.client)
    both = plant.joined("both.pem", between.certificate, plant.client.certificate)
    assert plant.warnings(ca_file=both, crl_file=crl) == [
        "certificate 1 of ca_file (CN=between) is revoked: its clients are refused",
        "certificate 2 of ca_file (CN=client) is revoked: this client is refused",
        "found no list of certificate 1 of ca_file (CN=between): its clients are refused",
    ]


@pytest.mark.parametrize(
    ("key", "signature"),
    [
        ("RSA", {}),
        ("RSA", {"digest": "sha1"}),
        ("RSA", {"options": (*WITH_PSS, *SALT_OF_KEY)}),
        ("RSA 1024", {}),
    ],
    ids=["SHA-256", "SHA-1", "PSS with the longest salt", "a short key"],
)
def test_a_listed_client_below_a_revoked_authority_is_refused_whatever_its_signature(
    key: str,
    signature: dict[str, Any],
    plant: Plant,
    mint: Mint,
    run: Run,
    caplog: pytest.LogCaptureFixture,
) -> None:
    root = Issued(plant.authority.ca, plant.authority.key)
    between = mint.make(by=root, name="between", key=key, extensions=(CA, SIGNS))
    client = mint.make(by=between, name="leaf", extensions=[named("a")], **signature)
    listed = plant.joined("listed.pem", root.certificate, between.certificate, client.certificate)
    files = {"ca_file": listed, "crl_file": plant.authority.revoke(between)}
    told = "certificate 3 of ca_file (CN=leaf) is revoked: this client is refused"
    assert told in plant.warnings(**files)
    appliance = run(plant.config(**files).read_text())
    assert "REVOKED" in verdict(appliance, context(plant.authority.ca, client, weak=True))
    assert reasons(appliance, caplog) == ["revoked"]


def test_a_list_can_revoke_a_client_that_is_listed_without_its_authority(
    plant: Plant, run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    files = {"ca_file": plant.client.certificate, "crl_file": plant.authority.revoke()}
    assert plant.warnings(**files) == []
    assert verdict(run(plant.config(**files).read_text()), plant.trust()) == "served"

    files["crl_file"] = plant.authority.revoke(plant.client)
    appliance = run(plant.config(**files).read_text())
    assert "REVOKED" in verdict(appliance, plant.trust())
    assert reasons(appliance, caplog) == ["revoked"]


def test_a_client_that_is_listed_with_its_authority_is_doubtful(plant: Plant) -> None:
    whole = plant.joined("whole.pem", plant.client.certificate, plant.authority.ca)
    assert plant.warnings(ca_file=whole) == [
        "certificate 1 (CN=client) is of the authority in certificate 2: all clients of that "
        "authority are trusted, not only this one"
    ]


def test_certificates_in_the_wrong_order_are_an_error(plant: Plant, mint: Mint) -> None:
    root = mint.root()
    between = mint.make(by=root, name="between", extensions=(CA, SIGNS))
    leaf = mint.make(by=between, name="leaf", extensions=[NAME])
    chain = (leaf.certificate, between.certificate, root.certificate)
    assert plant.warnings(cert_file=plant.joined("c.pem", *chain), key_file=leaf.key) == []
    wrong = plant.joined("wrong.pem", chain[0], chain[2], chain[1])
    with pytest.raises(ConfigError) as refused:
        load_whole(plant.config(cert_file=wrong, key_file=leaf.key))
    [problem] = refused.value.problems
    told = "certificate 2: found CN=authority, allowed: CN=between, the issuer of certificate 1"
    assert problem.message == f"{wrong}: {told}"


def test_a_listener_takes_no_certificates_of_https(plant: Plant) -> None:
    own = plant.files()
    del own["ca_file"]
    tls = _core.https_server_tls(**own)
    with pytest.raises(ValueError, match="tls is for an HTTPS server; use ServerTls"):
        _core.Listener("secure", "127.0.0.1:0", [], {**STREAM_DEFAULTS, "tls": tls})


def test_check_prints_warnings_and_succeeds(plant: Plant) -> None:
    file = plant.config(crl_file=plant.authority.revoke(dates=PAST))
    result = CliRunner().invoke(main, ["check", str(file)])
    assert result.exit_code == 0
    [line] = [line for line in result.stderr.splitlines() if "warning" in line]
    assert line.startswith(f"warning: {file}:")
    assert "listeners.secure.tls: " in line


def test_a_file_that_does_not_answer_stops_no_other_thread(tmp_path: Path) -> None:
    """As a file of a network file system whose server is away."""
    program = """
import os, sys, threading
import holdfast

silent = sys.argv[1]
os.mkfifo(silent)
files = {"cert_file": silent, "key_file": silent, "ca_file": silent}
threading.Thread(target=holdfast.ServerTls, kwargs=files, daemon=True).start()
with open(silent, "wb"):  # It is open for reading now, and has neither bytes nor an end.
    print("goes on", flush=True)
    os._exit(0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "silent")],
        capture_output=True,
        text=True,
        timeout=wire.DEADLINE,
        check=True,
    )
    assert done.stdout == "goes on\n"
