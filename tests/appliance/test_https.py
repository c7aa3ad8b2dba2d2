"""HTTPS in a configuration: what is served, what is checked, and when certificates expire."""

from __future__ import annotations

import signal
import socket
import ssl
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from click.testing import CliRunner
from cryptography import x509

from holdfast.appliance import Appliance
from holdfast.cli import main
from holdfast.config import load
from support import web, wire
from support.certificate_cases import Mint
from support.certificates import FUTURE, PAST, Certificates, Issued
from support.cli import RunCommand
from support.config_folder import written
from support.running import endpoint
from support.tls_peer import context

if TYPE_CHECKING:
    from pathlib import Path

NAMES = "DNS:localhost,IP:127.0.0.1"
SERVICES = ("rest", "gateway", "metrics")


class Files(NamedTuple):
    authority: Certificates
    server: Issued
    folder: Path

    def tls(self, issued: Issued | None = None, **more: Path) -> dict[str, str]:
        chosen = self.server if issued is None else issued
        files = {"cert_file": chosen.certificate, "key_file": chosen.key, **more}
        return {key: str(file) for key, file in files.items()}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("authority")
    authority = Certificates(folder)
    long_lived = ("20200101000000Z", "20900101000000Z")
    return Files(authority, authority.issue("server", NAMES, dates=long_lived), folder)


def configured(tmp_path: Path, tls: dict[str, Any], *services: str, port: int = 0) -> Path:
    at: dict[str, Any] = {"bind": f"127.0.0.1:{port}", "sources": ["127.0.0.0/8"], "tls": tls}
    whole = {
        "rest": {**at, "tokens": "none"},
        "gateway": {**at, "tokens": "none", "allow": ["127.0.0.1"], "access": "read-only"},
        "metrics": at,
    }
    chosen = {name: whole[name] for name in services or ("rest",)}
    file = tmp_path / "plant.yaml"
    file.write_text(written({"memories": {"plant_a": {"coils": 8}}, **chosen}))
    return file


def checked(file: Path) -> tuple[int, list[str]]:
    result = CliRunner().invoke(main, ["check", str(file)])
    return result.exit_code, result.stderr.splitlines()


def test_all_http_services_take_https(files: Files, tmp_path: Path) -> None:
    trust = context(files.authority.ca)
    with Appliance(load(configured(tmp_path, files.tls(), *SERVICES))) as appliance:
        assert [each.type for each in appliance.endpoints()] == ["https"] * 3
        paths = {"rest": "/api/v1/health", "gateway": "/", "metrics": "/metrics"}
        for service, path in paths.items():
            client = web.Client(endpoint(appliance, service), tls=trust)
            assert client.get(path).status == 200
            client.close()


def test_the_greeting_has_https(files: Files, tmp_path: Path) -> None:
    command = RunCommand(configured(tmp_path, files.tls(), *SERVICES))
    greeting = command.wait_for_greeting()
    assert command.end(signal.SIGTERM)[0] == 0
    assert greeting.count("  https://127.0.0.1:") == 3


def test_the_expiry_of_each_file_is_a_metric(files: Files, tmp_path: Path) -> None:
    revoked = files.authority.revoke()
    tls = files.tls(client_ca_file=files.authority.ca, crl_file=revoked)
    trust = context(files.authority.ca, files.server)
    with Appliance(load(configured(tmp_path, tls, "rest", "metrics"))) as appliance:
        client = web.Client(endpoint(appliance, "metrics"), tls=trust)
        lines = client.get("/metrics").body.decode().splitlines()
        client.close()
    told = dict(line.rsplit(" ", 1) for line in lines if "_expiry_" in line and line[0] != "#")
    [ca] = x509.load_pem_x509_certificates(files.authority.ca.read_bytes())
    crl = x509.load_pem_x509_crl(revoked.read_bytes())
    assert crl.next_update_utc is not None
    name = "holdfast_certificate_expiry_timestamp_seconds"
    lists = "holdfast_revocation_list_expiry_timestamp_seconds"
    assert {key: float(value) for key, value in told.items()} == {
        f'{name}{{file="{files.server.certificate}"}}': ssl.cert_time_to_seconds(
            "Jan  1 00:00:00 2090 GMT"
        ),
        f'{name}{{file="{files.authority.ca}"}}': ca.not_valid_after_utc.timestamp(),
        f'{lists}{{file="{revoked}"}}': crl.next_update_utc.timestamp(),
    }


def test_certificates_are_reloaded_all_or_none(files: Files, tmp_path: Path) -> None:
    def serial(appliance: Appliance) -> int:
        with socket.create_connection(endpoint(appliance, "rest"), wire.DEADLINE) as raw:
            trust = context(files.authority.ca)
            with trust.wrap_socket(raw, server_hostname="localhost") as client:
                return int(str((client.getpeercert() or {})["serialNumber"]), 16)

    def number(issued: Issued) -> int:
        return x509.load_pem_x509_certificate(issued.certificate.read_bytes()).serial_number

    renewed = files.authority.issue("renewed", NAMES)
    with Appliance(load(configured(tmp_path, files.tls(), "rest", "gateway"))) as appliance:
        assert serial(appliance) == number(files.server)
        config = load(configured(tmp_path, files.tls(renewed), "rest", "gateway"))
        appliance.reload(config)
        assert serial(appliance) == number(renewed)
        assert [str(renewed.certificate)] == list(appliance.diagnostics.stats()["certificates"])
        broken = load(configured(tmp_path, files.tls(), "rest", "gateway"))
        assert broken.gateway is not None
        assert broken.gateway.tls is not None
        unusable = broken.gateway.tls.model_copy(update={"key_file": renewed.key})
        gateway = broken.gateway.model_copy(update={"tls": unusable})
        with pytest.raises(OSError, match=r"gateway\.tls: .*not the key of the certificate"):
            appliance.reload(broken.model_copy(update={"gateway": gateway}))
        assert serial(appliance) == number(renewed)


# What `check` finds.


def test_a_good_configuration_has_no_warnings(files: Files, tmp_path: Path) -> None:
    assert checked(configured(tmp_path, files.tls(), *SERVICES)) == (0, [])


@pytest.mark.parametrize("service", ["rest", "gateway"])
def test_a_key_of_another_certificate_is_an_error(
    files: Files, tmp_path: Path, service: str
) -> None:
    other = files.authority.issue("other", NAMES)
    file = configured(tmp_path, files.tls(Issued(files.server.certificate, other.key)), service)
    told = f"{other.key}: it is not the key of the certificate in {files.server.certificate}"
    assert checked(file) == (2, [f"{file}:1: {service}.tls: {told}", "1 problem"])


def tomorrow() -> tuple[str, str]:
    """Dates that end in more than one day."""
    ends = datetime.now(UTC) + timedelta(hours=36)
    return "20200101000000Z", ends.strftime("%Y%m%d%H%M%SZ")


def test_dates_and_missing_names_are_warnings(files: Files, tmp_path: Path) -> None:
    late = files.authority.issue("late", NAMES, dates=PAST)
    early = files.authority.issue("early", NAMES, dates=FUTURE)
    soon = files.authority.issue("soon", NAMES, dates=tomorrow())
    nameless = files.authority.issue(
        "nameless", "email:a@b.example", dates=("20200101000000Z", "20900101000000Z")
    )
    texts = {
        late: ("", "certificate 1 (CN=late) expired "),
        early: ("", "certificate 1 (CN=early) is not valid yet, its validity begins in "),
        soon: (".cert_file", "the certificate of CN=soon expires in 1 day, on "),
        nameless: (
            ".cert_file",
            "found a subjectAltName without a DNS name or an IP address: clients ignore",
        ),
    }
    for issued, (key, text) in texts.items():
        file = configured(tmp_path, files.tls(issued))
        code, [line] = checked(file)
        start = f"warning: {file}:1: rest.tls{key}: {issued.certificate}: {text}"
        assert (code, line[: len(start)]) == (0, start)


def test_expired_revocation_lists_and_authorities_are_warnings(
    files: Files, tmp_path: Path
) -> None:
    revoked = files.authority.revoke(dates=tomorrow())
    late = Mint(tmp_path).root(name="late", dates=PAST).certificate
    both = tmp_path / "both.pem"
    both.write_bytes(files.authority.ca.read_bytes() + late.read_bytes())
    code, lines = checked(configured(tmp_path, files.tls(client_ca_file=both, crl_file=revoked)))
    assert code == 0
    [old, unlisted, soon] = lines
    assert f"rest.tls: {both}: certificate 2 (CN=late) expired " in old
    assert old.endswith(": its clients are refused")
    assert "found no list of certificate 2 of client_ca_file (CN=late)" in unlisted
    assert "rest.tls.crl_file: " in soon
    assert "the revocation list of CN=authority expires in 1 day" in soon


def test_revocation_lists_and_roles_need_authorities(files: Files, tmp_path: Path) -> None:
    for key, value in (("crl_file", files.authority.revoke()), ("roles", ["operator"])):
        file = configured(tmp_path, files.tls() | {key: str(value) if key == "crl_file" else value})
        message = f"rest.tls.{key}: found without client_ca_file, allowed: only with it"
        assert checked(file) == (2, [f"{file}:1: {message}", "1 problem"])


def test_the_settings_of_client_certificates_are_checked(files: Files, tmp_path: Path) -> None:
    ca = {"client_ca_file": str(files.authority.ca)}
    file = configured(tmp_path, {**files.tls(), **ca, "expired_crl": "accept"})
    code, [line, _] = checked(file)
    assert (code, "rest.tls.expired_crl: removed, clients are refused after" in line) == (2, True)
    file = configured(tmp_path, {**files.tls(), **ca, "roles": ["a", "b", "a"]})
    code, [line, _] = checked(file)
    assert (code, "rest.tls.roles" in line) == (2, True)


@pytest.mark.parametrize("key", ["cert_file", "key_passphrase_file", "client_ca_file"])
def test_files_that_can_t_be_read_are_errors(files: Files, tmp_path: Path, key: str) -> None:
    tls = {**files.tls(), key: "none.pem"}
    file = configured(tmp_path, tls)
    code, [line, _] = checked(file)
    told = "found 'none.pem', which can't be read: No such file or directory"
    assert (code, line) == (2, f"{file}:1: rest.tls.{key}: {told}")


def test_a_file_that_breaks_before_the_start_is_told(files: Files, tmp_path: Path) -> None:
    own = tmp_path / "own.pem"
    own.write_bytes(files.server.certificate.read_bytes())
    config = load(configured(tmp_path, files.tls(Issued(own, files.server.key))))
    own.write_text("")
    with pytest.raises(OSError, match=r"rest\.tls: .*own\.pem: found no certificate"):
        Appliance(config).start()


# `holdfast watch` reads over REST.


def watched(file: Path) -> tuple[int, str, str]:
    result = CliRunner().invoke(main, ["watch", str(file), "--times", "1", "--every", "0.05"])
    return result.exit_code, result.stdout, result.stderr


def test_watch_reads_over_https(files: Files, tmp_path: Path) -> None:
    with Appliance(load(configured(tmp_path, files.tls()))) as appliance:
        port = endpoint(appliance, "rest")[1]
        code, _, errors = watched(configured(tmp_path, files.tls(), port=port))
    assert (code, errors) == (0, f"watching REST at https://127.0.0.1:{port}\n")


def test_watch_sends_nothing_to_another_server(files: Files, tmp_path: Path) -> None:
    other = files.authority.issue("impostor", NAMES)
    with Appliance(load(configured(tmp_path, files.tls(other)))) as appliance:
        port = endpoint(appliance, "rest")[1]
        code, _, errors = watched(configured(tmp_path, files.tls(), port=port))
        counted = appliance.diagnostics.stats()["adapters"]["rest"]["connections"]
        wire.until(lambda: counted["accepted"] == 1, "it connected")
    assert code == 1
    assert "the server has another certificate than its configuration" in errors


def test_watch_has_no_client_certificate(files: Files, tmp_path: Path) -> None:
    file = configured(tmp_path, files.tls(client_ca_file=files.authority.ca), port=9)
    assert (watched(file)[0], "rest requires client certificates" in watched(file)[2]) == (2, True)
