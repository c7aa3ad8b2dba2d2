"""`holdfast cert`: openssl, our listener and our clients take what it makes."""

from __future__ import annotations

import errno
import json
import os
import ssl
import stat
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from cryptography import x509

import holdfast
from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.net.certificates import authority
from holdfast.net.certificates.authority import KEY_KINDS
from holdfast.net.certificates.inspection import serial_text
from support import wire
from support.certificates import PAST, ROLE, Certificates, named
from support.cli import invoke, usage_error
from support.machine import tool
from support.tls_peer import address, configuration, context, verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from click.testing import Result

ROLES = [
    {"sources": ["127.0.0.0/8"], "roles": ["engineer"], "access": "read-write"},
    {"sources": ["127.0.0.0/8"], "roles": ["operator"], "access": "read-only"},
]


class Pki:
    """A folder in which the commands work."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def tries(self, command: str, *arguments: str) -> Result:
        where = () if command == "show" else ("--folder", str(self.path))
        return invoke("cert", command, *arguments, *where)

    def does(self, command: str, *arguments: str) -> str:
        result = self.tries(command, *arguments)
        assert (result.exit_code, result.stderr) == (0, "")
        return result.stdout

    def refuses(self, command: str, *arguments: str) -> str:
        result = self.tries(command, *arguments)
        assert (result.exit_code, result.stdout) == (2, ""), result.output
        return result.stderr.strip()

    def certificate(self, name: str) -> x509.Certificate:
        return x509.load_pem_x509_certificates((self / name).read_bytes())[0]

    def shown(self, file: Path | str) -> list[dict[str, Any]]:
        result = self.tries("show", str(self / str(file)), "--json")
        found: list[dict[str, Any]] = json.loads(result.stdout)["found"]
        return found


@pytest.fixture
def pki(tmp_path: Path) -> Pki:
    made = Pki(tmp_path)
    made.does("ca", "Plant authority")
    return made


@pytest.fixture
def plant(pki: Pki) -> Pki:
    """With a server, and clients of two roles."""
    pki.does("server", "plc", "--san", "localhost", "--san", "127.0.0.1", "--san", "::1")
    pki.does("client", "engineer", "--role", "engineer")
    pki.does("client", "panel", "--role", "operator")
    return pki


def verified(pki: Pki, name: str, purpose: str, *more: str) -> str:
    """What openssl says about a certificate; empty if it is trusted."""
    command = [tool("openssl"), "verify", "-x509_strict", "-purpose", purpose, *more]
    done = subprocess.run(
        [*command, "-CAfile", str(pki / "ca.pem"), str(pki / name)],
        capture_output=True,
        text=True,
        check=False,
    )
    return "" if done.returncode == 0 else done.stderr


@pytest.fixture
def served(plant: Pki) -> Iterator[Appliance]:
    plant.does("crl")
    files = {
        "cert_file": plant / "plc.pem",
        "key_file": plant / "plc.key",
        "ca_file": plant / "ca.pem",
        "crl_file": plant / "crl.pem",
    }
    file = plant / "plant.yaml"
    file.write_text(configuration(files, ROLES))
    with Appliance(load(file)) as appliance:
        yield appliance


# What is made works.


def test_openssl_trusts_the_certificates_for_their_purpose_alone(plant: Pki) -> None:
    assert verified(plant, "ca.pem", "any") == ""
    assert verified(plant, "plc.pem", "sslserver") == ""
    assert verified(plant, "engineer.pem", "sslclient") == ""
    assert "unsuitable certificate purpose" in verified(plant, "engineer.pem", "sslserver")
    assert "unsuitable certificate purpose" in verified(plant, "plc.pem", "sslclient")


def test_the_listener_and_the_clients_take_them(plant: Pki, served: Appliance) -> None:
    url = f"tls://127.0.0.1:{address(served)[1]}?ca={plant / 'ca.pem'}"
    for name, may_write in {"engineer": True, "panel": False}.items():
        own = f"&cert={plant / name}.pem&key={plant / name}.key"
        with holdfast.SyncClient(url + own, unit=1, timeout=wire.DEADLINE) as client:
            assert client.read_holding_registers(0, 1) == [0]
            if may_write:
                client.write_register(0, 0)
            else:
                with pytest.raises(holdfast.ModbusException):
                    client.write_register(0, 0)


def test_openssl_s_client_connects(plant: Pki, served: Appliance) -> None:
    host, port = address(served)
    own = ("-cert", plant / "panel.pem", "-key", plant / "panel.key", "-CAfile", plant / "ca.pem")
    named_host = ("-verify_return_error", "-verify_hostname", "localhost")
    done = subprocess.run(
        [tool("openssl"), "s_client", "-connect", f"{host}:{port}", *own, *named_host],
        input=b"",
        capture_output=True,
        check=False,
    )
    assert (done.returncode, b"Verify return code: 0 (ok)" in done.stdout) == (0, True)


@pytest.mark.parametrize("kind", KEY_KINDS)
def test_every_kind_of_key_is_served(tmp_path: Path, kind: str) -> None:
    pki = Pki(tmp_path)
    pki.does("ca", "authority", "--key-type", kind)
    pki.does("server", "plc", "--san", "localhost", "--key-type", kind)
    pki.does("client", "panel", "--role", "operator", "--key-type", kind)
    assert verified(pki, "plc.pem", "sslserver") == ""
    files = {
        "cert_file": pki / "plc.pem",
        "key_file": pki / "plc.key",
        "ca_file": pki / "ca.pem",
    }
    file = pki / "plant.yaml"
    file.write_text(configuration(files, ROLES))
    with Appliance(load(file)) as appliance:
        trust = ssl.create_default_context(cafile=str(pki / "ca.pem"))
        trust.load_cert_chain(pki / "panel.pem", pki / "panel.key")
        assert verdict(appliance, trust) == "served"


def test_the_role_is_a_utf8_string(pki: Pki) -> None:
    for name, role in {"short": "Bedienerin Süd", "long": "r" * 255}.items():
        pki.does("client", name, "--role", role)
        [panel, _] = pki.shown(f"{name}.pem")
        assert (panel["fields"]["role"], panel["flaws"], panel["advice"]) == (role, [], [])
        parsed = subprocess.run(
            [tool("openssl"), "x509", "-in", pki / f"{name}.pem", "-noout", "-text"],
            capture_output=True,
            check=True,
        )
        assert b"1.3.6.1.4.1.50316.802.1" in parsed.stdout


def test_certificates_have_careful_defaults(plant: Pki) -> None:
    ca, plc, panel = (plant.certificate(name) for name in ("ca.pem", "plc.pem", "panel.pem"))
    years = timedelta(days=3650), timedelta(days=730), timedelta(days=730)
    for each, days in zip((ca, plc, panel), years, strict=True):
        span = each.not_valid_after_utc - datetime.now(UTC)
        assert days - timedelta(hours=1) < span <= days
    constraints = ca.extensions.get_extension_for_class(x509.BasicConstraints)
    assert (constraints.critical, constraints.value.ca, constraints.value.path_length) == (
        True,
        True,
        0,
    )
    names = plc.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(each.value) for each in names] == ["localhost", "127.0.0.1", "::1"]
    usage = plc.extensions.get_extension_for_class(x509.KeyUsage)
    assert (usage.critical, usage.value.digital_signature, usage.value.key_cert_sign) == (
        True,
        True,
        False,
    )
    assert len({ca.serial_number, plc.serial_number, panel.serial_number}) == 3
    for name in ("plc.pem", "panel.pem"):
        assert (plant / name).read_bytes().endswith((plant / "ca.pem").read_bytes())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no modes")
def test_keys_are_readable_by_their_owner_alone(plant: Pki) -> None:
    modes = {each.name: stat.S_IMODE(each.stat().st_mode) for each in plant.path.glob("*.key")}
    assert modes == dict.fromkeys(("ca.key", "plc.key", "engineer.key", "panel.key"), 0o600)


def test_no_certificate_outlives_its_authority(tmp_path: Path) -> None:
    pki = Pki(tmp_path)
    pki.does("ca", "short", "--days", "5")
    pki.does("client", "panel")
    assert pki.certificate("panel.pem").not_valid_after_utc == (
        pki.certificate("ca.pem").not_valid_after_utc
    )


def test_files_may_be_elsewhere(pki: Pki, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    ca = ("--ca", str(pki / "ca.pem"), "--ca-key", str(pki / "ca.key"))
    Pki(other).does("client", "panel", *ca)
    assert verified(pki, "other/panel.pem", "sslclient") == ""


# What is refused.


def test_nothing_is_overwritten(plant: Pki) -> None:
    before = {file: file.read_bytes() for file in plant.path.iterdir()}
    assert plant.refuses("ca", "again").endswith("ca.key exists, and is not overwritten")
    assert plant.refuses("client", "panel").endswith("panel.key exists, and is not overwritten")
    (plant / "panel.key").unlink()
    assert plant.refuses("client", "panel").endswith("panel.pem exists, and is not overwritten")
    del before[plant / "panel.key"]
    assert {file: file.read_bytes() for file in plant.path.iterdir()} == before


@pytest.mark.parametrize(
    "name", ["../panel", "a/b", "ca", "crl", "CRL", "", ".hidden", "a b", "x" * 65]
)
def test_names_stay_in_the_folder(pki: Pki, name: str) -> None:
    told = pki.refuses("client", name)
    assert "allowed: 1 to 64 letters" in told
    assert "neither `ca` nor `crl`" in told


def test_a_write_that_fails_is_reported_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    told = Pki(tmp_path).refuses("ca", "Plant authority")
    assert told == f"holdfast: {tmp_path / 'ca.key'}: No space left on device"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a b", "*.*.example", "-a", "10.0.0.256/8", "ä.example", ""])
def test_alternative_names_are_checked(pki: Pki, name: str) -> None:
    told = pki.refuses("server", "plc", f"--san={name}")
    assert told == f"holdfast: found {name!r}, allowed: a DNS name or an IP address"


def test_a_server_needs_a_name(pki: Pki) -> None:
    assert "'--san'" in usage_error("cert", "server", "plc", "--folder", str(pki.path))


@pytest.mark.parametrize("role", ["", "r" * 256])
def test_roles_are_checked(pki: Pki, role: str) -> None:
    told = pki.refuses("client", "panel", "--role", role)
    assert told == f"holdfast: found a role of {len(role)} bytes, allowed: 1 to 255"
    assert not (pki / "panel.key").exists()


def test_bytes_that_are_not_text_are_refused(tmp_path: Path) -> None:
    pki = Pki(tmp_path)
    assert pki.refuses("ca", "a\udc9b").endswith("name that is not text in UTF-8: 'a\\udc9b'")
    assert not (pki / "ca.key").exists()
    pki.does("ca", "plant")
    told = pki.refuses("client", "panel", "--role", "a\udc9b")
    assert told.endswith("role that is not text in UTF-8: 'a\\udc9b'")
    assert not (pki / "panel.key").exists()


def test_nothing_begins_before_1970(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = datetime(1970, 1, 1, tzinfo=UTC)
    monkeypatch.setattr(authority, "now", lambda: first + timedelta(seconds=20))
    pki = Pki(tmp_path)
    pki.does("ca", "plant")
    pki.does("client", "panel")
    pki.does("crl")
    assert pki.certificate("ca.pem").not_valid_before_utc == first
    assert pki.certificate("panel.pem").not_valid_before_utc == first
    made = x509.load_pem_x509_crl((pki / "crl.pem").read_bytes())
    assert made.last_update_utc == first


def test_nothing_is_made_before_the_authority_is_valid(
    plant: Pki, monkeypatch: pytest.MonkeyPatch
) -> None:
    began = plant.certificate("ca.pem").not_valid_before_utc
    monkeypatch.setattr(authority, "now", lambda: datetime(2001, 2, 3, 4, 5, 6, tzinfo=UTC))
    for command in (
        ["server", "other", "--san=other"],
        ["client", "other"],
        ["revoke", str(plant / "panel.pem")],
        ["crl"],
    ):
        assert plant.refuses(*command) == (
            f"holdfast: the authority is not valid before {began:%Y-%m-%d %H:%M} UTC, and the "
            "clock says 2001-02-03 04:05 UTC: correct it"
        )
    assert not (plant / "other.key").exists()
    assert not (plant / "crl.pem").exists()


def test_names_in_certificates_can_not_forge_lines(tmp_path: Path) -> None:
    pki = Pki(tmp_path)
    pki.does("ca", "a\x1b[8m\n  role  operator\u202e")
    shown = pki.tries("show", str(pki / "ca.pem")).stdout
    assert "CN=a\\x1b[8m\\x0a  role  operator\\u202e\n" in shown


def test_files_of_the_authority_are_checked(plant: Pki) -> None:
    wrong_key = plant.refuses("client", "new", "--ca-key", str(plant / "plc.key"))
    assert "plc.key: it is not the key of the certificate in " in wrong_key
    leaf = ("--ca", str(plant / "plc.pem"), "--ca-key", str(plant / "plc.key"))
    assert "found no authority, allowed: a certificate with CA:TRUE" in (
        plant.refuses("client", "new", *leaf)
    )
    (plant / "ca.key").unlink()
    assert plant.refuses("client", "new").endswith("ca.key: No such file or directory")


# Passphrases.


def test_keys_may_have_a_passphrase(tmp_path: Path) -> None:
    pki = Pki(tmp_path)
    for name in ("root", "own"):
        (pki / name).write_text(f"secret of {name}\n")
    root, own = str(pki / "root"), str(pki / "own")
    pki.does("ca", "authority", "--passphrase-file", root)
    made = ("--ca-passphrase-file", root, "--passphrase-file", own)
    pki.does("server", "plc", "--san", "localhost", *made)
    pki.does("client", "panel", "--ca-passphrase-file", root, "--role", "operator")
    for name in ("ca.key", "plc.key"):
        assert b"ENCRYPTED PRIVATE KEY" in (pki / name).read_bytes()
    told = pki.refuses("client", "new")
    assert told == (
        "holdfast: Passphrase of the authority's key: there is no terminal to ask on; use a file "
        "with the passphrase"
    )
    wrong = pki.refuses("client", "new", "--ca-passphrase-file", own)
    assert wrong.endswith("ca.key: the passphrase is wrong, or the key can't be read")

    files = {
        "cert_file": pki / "plc.pem",
        "key_file": pki / "plc.key",
        "key_passphrase_file": pki / "own",
        "ca_file": pki / "ca.pem",
    }
    file = pki / "plant.yaml"
    file.write_text(configuration(files, ROLES))
    with Appliance(load(file)) as appliance:
        trust = ssl.create_default_context(cafile=str(pki / "ca.pem"))
        trust.load_cert_chain(pki / "panel.pem", pki / "panel.key")
        assert verdict(appliance, trust) == "served"
    (pki / "own").write_text("other\n")
    result = invoke("check", str(file))
    assert result.exit_code == 2
    assert "plc.key: the passphrase is wrong, or the key can't be read" in result.stderr


# Revocation.


def test_revoked_certificates_are_refused(plant: Pki, served: Appliance) -> None:
    assert (
        verified(plant, "panel.pem", "sslclient", "-CRLfile", str(plant / "crl.pem"), "-crl_check")
        == ""
    )
    told = plant.does("revoke", str(plant / "panel.pem"))
    assert told == f"Written: {plant / 'crl.pem'}; 1 certificate is revoked.\n"
    listed = ("-CRLfile", str(plant / "crl.pem"), "-crl_check")
    assert "certificate revoked" in verified(plant, "panel.pem", "sslclient", *listed)
    assert verified(plant, "engineer.pem", "sslclient", *listed) == ""
    served.stop()
    with Appliance(load(plant / "plant.yaml")) as again:
        trust = {name: context(plant / "ca.pem") for name in ("panel", "engineer")}
        for name, each in trust.items():
            each.load_cert_chain(plant / f"{name}.pem", plant / f"{name}.key")
        assert verdict(again, trust["engineer"]) == "served"
        assert verdict(again, trust["panel"]) == "SSLV3_ALERT_CERTIFICATE_REVOKED"


def test_entries_stay_in_the_list_and_its_number_rises(plant: Pki) -> None:
    def numbers() -> tuple[int, list[str]]:
        read = x509.load_pem_x509_crl((plant / "crl.pem").read_bytes())
        number = read.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
        [shown] = plant.shown("crl.pem")
        return number, [entry["serial"] for entry in shown["fields"]["revoked"]]

    own = [plant.certificate(f"{name}.pem") for name in ("panel", "engineer")]
    serials = [serial_text(each.serial_number) for each in own]
    plant.does("revoke", str(plant / "panel.pem"))
    assert numbers() == (1, serials[:1])
    plant.does("revoke", str(plant / "engineer.pem"), str(plant / "panel.pem"))
    assert numbers() == (2, serials)
    plant.does("crl", "--days", "9")
    assert numbers() == (3, serials)
    assert sorted(each.name for each in plant.path.glob("*crl*")) == ["crl.pem"]


def test_only_its_own_certificates_and_lists_are_taken(plant: Pki, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    other = Pki(folder)
    other.does("ca", "Plant authority")
    other.does("client", "panel")
    other.does("crl")
    told = plant.refuses("revoke", str(other / "panel.pem"))
    assert told.endswith("panel.pem: the authority has not issued this certificate")
    told = plant.refuses("crl", "--crl", str(other / "crl.pem"))
    assert told == "holdfast: the revocation list is that of another authority"


# `cert show`.


def test_show_describes_a_whole_file(plant: Pki) -> None:
    [plc, ca] = plant.shown("plc.pem")
    assert plc["fields"]["names"] == ["localhost", "127.0.0.1", "::1"]
    assert (plc["fields"]["purpose"], ca["fields"]["purpose"]) == (["server"], ["authority"])
    assert (plc["fields"]["key"], plc["fields"]["authority"]) == ("P-256", False)
    assert plc["flaws"] == ca["flaws"] == plc["advice"] == []
    text = plant.does("show", str(plant / "plc.pem"))
    assert "  names       localhost, 127.0.0.1, ::1\n" in text
    secret = plant.does("show", str(plant / "plc.key"))
    assert "PRIVATE" not in secret
    assert "  key                P-256\n" in secret


def test_show_names_what_a_certificate_fails(tmp_path: Path) -> None:
    other = Certificates(tmp_path)
    cases: dict[str, tuple[list[str], str]] = {
        "number": ([named("operator", "IA5String")], "R-22: the role is not a UTF8String"),
        "critical": (
            ["1.3.6.1.4.1.50316.802.1=critical,ASN1:UTF8String:a"],
            "the role is critical, which most devices refuse",
        ),
        "chain": ([named("a")], "R-46: the chain is incomplete: the file has no CN=authority"),
    }
    for name, (extensions, flaw) in cases.items():
        issued = other.issue(name, "DNS:a", extensions=extensions)
        result = invoke("cert", "show", str(issued.certificate))
        assert result.exit_code == 1
        assert f"  fails: {flaw}\n" in f"{result.stdout}\n"
    two = other.issue("two", "DNS:a", extensions=[named("a"), f"{ROLE[:-1]}2=ASN1:UTF8String:b"])
    der = ssl.PEM_cert_to_DER_cert(two.certificate.read_text())
    arc = bytes.fromhex("2b060104018389 0c8622")
    two.certificate.write_text(ssl.DER_cert_to_PEM_cert(der.replace(arc + b"\2", arc + b"\1")))
    told = invoke("cert", "show", str(two.certificate)).stdout
    assert "  fails: R-65: the role occurs twice\n" in told
    late = other.issue("late", "DNS:a", dates=PAST, extensions=[named("a")])
    told = invoke("cert", "show", str(late.certificate)).stdout
    assert "  fails: R-47: the certificate expired on 2020-02-01\n" in told
    told = invoke("cert", "show", str(other.issue("null", "DNS:a").certificate)).stdout
    assert "  note: R-20: a client's certificate should have a role" in told
    listed = other.revoke(late, reason="superseded")
    assert "superseded" in invoke("cert", "show", str(listed)).stdout


def test_show_prints_no_warning_about_a_negative_serial_number(plant: Pki) -> None:
    old = plant / "old.pem"
    der = ssl.PEM_cert_to_DER_cert((plant / "ca.pem").read_text().strip())
    number = plant.certificate("ca.pem").serial_number
    positive = number.to_bytes(number.bit_length() // 8 + 1, "big")
    negative = b"\x80" + positive[1:]
    old.write_text(ssl.DER_cert_to_PEM_cert(der.replace(positive, negative)))
    command = [sys.executable, "-m", "holdfast", "cert", "show", str(old)]
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "serial      -" in shown.stdout
    assert shown.stderr == ""


def test_show_names_a_key_that_does_not_fit(plant: Pki) -> None:
    both = plant / "both.pem"
    both.write_bytes((plant / "plc.pem").read_bytes() + (plant / "panel.key").read_bytes())
    told = plant.tries("show", str(both))
    assert told.exit_code == 1
    assert "fails: it is not the key of the first certificate" in told.stdout


@pytest.mark.parametrize(
    "text", ["", "nothing\n", "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"]
)
def test_show_refuses_what_it_can_not_read(pki: Pki, text: str) -> None:
    (pki / "x.pem").write_text(text)
    assert pki.refuses("show", str(pki / "x.pem")).startswith(f"holdfast: {pki / 'x.pem'}: ")


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal")
def test_passphrases_are_asked_for_and_not_shown(tmp_path: Path) -> None:
    from support.terminal import Terminal

    where = ("--folder", str(tmp_path))
    with Terminal("cert", "ca", "authority", "--passphrase", *where) as terminal:
        for asked in ("Passphrase of the new key: ", "Repeat for confirmation: "):
            terminal.until(asked)
            terminal.keys("over the hills\n")
        assert terminal.end() == 0
        assert "hills" not in terminal.shown
    with Terminal("cert", "client", "panel", *where) as terminal:
        terminal.until("Passphrase of the authority's key: ")
        terminal.keys("over the hills\n")
        assert terminal.end() == 0
    assert verified(Pki(tmp_path), "panel.pem", "sslclient") == ""
