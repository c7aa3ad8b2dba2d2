"""The gateway and devices with TLS: whom it trusts, what it shows them, and what fails how."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

import holdfast
from holdfast.appliance import Appliance
from holdfast.cli import main
from holdfast.client.url import NetworkTarget, Tls
from holdfast.config import load
from support import gateways, web
from support.cli import usage_error
from support.gateways import PLC, Dialed, Names
from support.secured import VERSIONS, Authority, Relay, context

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.secured import Owner


HOST = "IP:127.0.0.1"
TARGET = {"host": "127.0.0.1", "transport": "tls"}
READ = {"functionCode": 3, "address": 0, "quantity": 3}
UNKNOWN = (
    "the issuer of the certificate is unknown: neither the certificate nor an authority above it "
    "is trusted"
)


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("stranger"), "stranger")


@pytest.fixture(scope="module")
def plc(authority: Authority) -> Owner:
    return authority.issue("plc", HOST)


@pytest.fixture(scope="module")
def panel(authority: Authority) -> Owner:
    return authority.issue("panel", "DNS:panel")


@pytest.fixture(scope="module")
def trust(authority: Authority) -> Tls:
    return Tls(ca=str(authority.ca))


@pytest.fixture
def behind(server: holdfast.Server, memory: holdfast.Memory) -> tuple[str, int]:
    """What is behind the TLS: a server of ours."""
    memory.write("holding_registers", 0, [11, 22, 33])
    return server.address


@pytest.fixture
def device(behind: tuple[str, int], plc: Owner) -> Iterator[Relay]:
    with Relay(behind, context(plc)) as relay:
        yield relay


def at(relay: Relay, **more: Any) -> dict[str, Any]:
    """The body of a read of a device."""
    return {**TARGET, "port": relay.address[1], **READ, **more}


def failure(answer: web.Answer) -> tuple[str, str]:
    """The reason and the error of an answer that says that there was no connection."""
    assert (answer.status, answer.json["success"]) == (500, False)
    return answer.headers["holdfast-reason"], answer.json["error"]


# What works.


@pytest.mark.parametrize("version", VERSIONS)
def test_a_device_is_read_and_written(
    behind: tuple[str, int], plc: Owner, trust: Tls, memory: holdfast.Memory, version: str
) -> None:
    with Relay(behind, context(plc, version)) as relay, gateways.running(tls=trust) as running:
        answer = running.ask("/read", at(relay))
        assert (answer.status, answer.json["values"]) == (200, [11, 22, 33])
        assert answer.json["host"] == "127.0.0.1"
        write = {**TARGET, "port": relay.address[1], "address": 1, "value": 7}
        assert running.ask("/write/register", write).json["success"] is True
        assert memory.read("holding_registers", 1, 1) == [7]
        assert relay.connections == 1
        assert running.client().get("/api/gateway").json["connections"] == 1


def test_every_endpoint_takes_it(device: Relay, trust: Tls) -> None:
    asked: dict[str, dict[str, Any]] = {
        "/connect": {},
        "/read": READ,
        "/write/coil": {"address": 0, "value": True},
        "/write/coils": {"address": 0, "values": [True]},
        "/write/register": {"address": 0, "value": 1},
        "/write/registers": {"address": 0, "values": [1]},
        "/write/mask": {"address": 0, "andMask": 0, "orMask": 1},
        "/readwrite": {"readAddress": 0, "readQuantity": 1, "writeAddress": 0, "values": [1]},
        "/diagnostics": {},
        "/server-id": {},
        "/identify": {},
    }
    with gateways.running(tls=trust) as running:
        for path, body in asked.items():
            answer = running.ask(path, {**TARGET, "port": device.address[1], **body})
            assert (answer.status, answer.json["success"]) == (200, True), path
    assert device.connections == 1


def test_a_device_is_mapped_and_watched(device: Relay, trust: Tls, memory: holdfast.Memory) -> None:
    with gateways.running(tls=trust) as running:
        body = {**TARGET, "port": device.address[1], "areas": ["holding_registers"], "last": 99}
        found = running.stream("POST", "/map", body).next("result")
        assert found["success"] is True
        query = f"?host=127.0.0.1&port={device.address[1]}&transport=tls&interval=100"
        stream = running.stream("GET", f"/watch{query}&functionCode=3&address=0")
        assert stream.next("values")["values"] == [11]
        memory.write("holding_registers", 0, [12])
        assert stream.next("change")["changes"] == [{"address": 0, "value": 12}]


def test_802_is_the_port_if_none_is_given(device: Relay, trust: Tls) -> None:
    dialed = Dialed({("127.0.0.1", 802): device.address})
    with gateways.running(allow=["127.0.0.0/8"], tls=trust, dialed=dialed) as running:
        assert running.ask("/connect", TARGET).json["port"] == 802
    assert dialed.calls == [
        NetworkTarget("tls", "127.0.0.1", 802, replace(trust, name="127.0.0.1"))
    ]


def test_a_write_is_logged_with_its_port(device: Relay, trust: Tls, log: web.Records) -> None:
    dialed = Dialed({("127.0.0.1", 802): device.address})
    with gateways.running(allow=["127.0.0.0/8"], tls=trust, dialed=dialed) as running:
        running.ask("/write/register", {**TARGET, "address": 0, "value": 1})
    assert [each["target"] for each in log.of("gateway_write")] == ["127.0.0.1:802"]


# The name that a certificate must have.


@pytest.mark.parametrize("host", [PLC, "PLC.factory.local", "plc.factory.local."])
def test_a_certificate_is_for_the_name_that_was_asked_for(
    behind: tuple[str, int], authority: Authority, trust: Tls, host: str
) -> None:
    async def anybody(_: str) -> list[str]:
        return ["127.0.0.1"]

    owner = authority.issue("named", f"DNS:{PLC}")
    dialed = Dialed()
    with (
        Relay(behind, context(owner)) as relay,
        gateways.running(tls=trust, resolve=anybody, dialed=dialed) as running,
    ):
        assert running.ask("/read", at(relay, host=host)).json["values"] == [11, 22, 33]
        assert failure(running.ask("/read", at(relay))) == (
            "tls_failed",
            f"can't connect to 127.0.0.1:{relay.address[1]}: the certificate is for "
            f"'{PLC}', not for '127.0.0.1'",
        )
    assert [each.host for each in dialed.calls] == ["127.0.0.1"] * 2


def test_an_address_in_brackets_or_in_ipv6_is_that_address(device: Relay, trust: Tls) -> None:
    with gateways.running(tls=trust) as running:
        for host in ("::ffff:127.0.0.1", "[::ffff:127.0.0.1]", "127.0.0.1"):
            assert running.ask("/read", at(device, host=host)).status == 200
    assert device.connections == 1


def test_a_certificate_for_another_name_is_told(device: Relay, trust: Tls) -> None:
    names = Names(plc_factory_local=[["127.0.0.1"]])
    with gateways.running(tls=trust, resolve=names) as running:
        assert failure(running.ask("/read", at(device, host=PLC))) == (
            "tls_failed",
            f"can't connect to {PLC}:{device.address[1]}: the certificate is for '127.0.0.1', "
            f"not for '{PLC}'",
        )


def test_a_server_name_takes_the_place_of_the_host(
    behind: tuple[str, int], authority: Authority, trust: Tls
) -> None:
    owner = authority.issue("drive", "DNS:drive-7")
    with (
        Relay(behind, context(owner)) as relay,
        gateways.running(tls=trust) as running,
    ):
        for name, status in (("drive-7", 200), ("drive-8", 500), ("DRIVE-7", 200), (None, 500)):
            more = {} if name is None else {"serverName": name}
            assert running.ask("/read", at(relay, **more)).status == status, name
        assert relay.agreed == 1, "a connection is shared by its name only"


# Whom it trusts, and what it shows.


def test_a_strange_authority_is_told(
    behind: tuple[str, int], stranger: Authority, trust: Tls
) -> None:
    with (
        Relay(behind, context(stranger.issue("plc", HOST))) as relay,
        gateways.running(tls=trust) as running,
    ):
        said = f"can't connect to 127.0.0.1:{relay.address[1]}: {UNKNOWN}"
        assert failure(running.ask("/read", at(relay))) == ("tls_failed", said)


def test_without_files_the_system_says_who_is_trusted(
    device: Relay, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    with gateways.running() as running:
        assert failure(running.ask("/read", at(device)))[1].endswith(UNKNOWN)
        monkeypatch.setenv("SSL_CERT_FILE", str(authority.ca))
        assert running.ask("/read", at(device)).status == 200


@pytest.mark.parametrize("version", VERSIONS)
def test_a_device_that_asks_for_a_certificate_is_shown_one(
    behind: tuple[str, int],
    authority: Authority,
    plc: Owner,
    panel: Owner,
    trust: Tls,
    version: str,
) -> None:
    asking = context(plc, version, asks=authority.ca)
    with Relay(behind, asking) as relay:
        with gateways.running(tls=trust) as running:
            reason, said = failure(running.ask("/read", at(relay)))
        assert reason == "tls_failed"
        assert "certificate" in said
        shown = replace(trust, cert=str(panel[0]), key=str(panel[1]))
        with gateways.running(tls=shown) as running:
            assert running.ask("/read", at(relay)).json["values"] == [11, 22, 33]


def test_callers_have_no_say_in_whom_it_trusts(device: Relay, trust: Tls) -> None:
    with gateways.running(tls=trust) as running:
        for field in ("ca", "cert", "key", "tls", "name"):
            answer = running.ask("/read", at(device, **{field: "/etc/passwd"}))
            assert (answer.status, answer.headers["holdfast-reason"]) == (400, "malformed")
        answer = running.ask("/read", at(device, serverName="127.0.0.1?ca=/etc/passwd"))
        assert answer.status == 400
    assert device.connections == 0


# What is no device with TLS.


def test_a_device_without_tls_is_told(behind: tuple[str, int], trust: Tls) -> None:
    with Relay(behind) as relay, gateways.running(tls=trust) as running:
        reason, said = failure(running.ask("/read", at(relay)))
        host, port = relay.address
    assert reason == "tls_failed"
    assert said == (
        f"can't connect to {host}:{port}: the peer closed the connection during the TLS handshake"
    )


def test_nobody_at_the_port_is_no_connection(device: Relay, trust: Tls) -> None:
    with Relay(device.address) as gone:
        port = gone.address[1]
    with gateways.running(tls=trust) as running:
        answer = running.ask("/read", {**TARGET, "port": port, **READ})
        said = f"can't connect to 127.0.0.1:{port}: Connection refused"
        assert failure(answer) == ("no_connection", said)


@pytest.mark.parametrize(
    ("allow", "port"), [("10.0.0.0/8:*", None), ("127.0.0.0/8", 803), ("127.0.0.0/8:502", None)]
)
def test_a_target_outside_the_list_is_refused(trust: Tls, allow: str, port: int | None) -> None:
    dialed = Dialed()
    body = {**TARGET, **READ, **({} if port is None else {"port": port})}
    with gateways.running(allow=[allow], tls=trust, dialed=dialed) as running:
        answer = running.ask("/read", {**body, "serverName": "10.0.0.1"})
    assert (answer.status, answer.headers["holdfast-reason"]) == (403, "refused_target")
    assert dialed.calls == []


# Its files.


@pytest.fixture
def files(tmp_path: Path, authority: Authority, panel: Owner) -> Path:
    """A folder with an authority, a certificate and its key, and files that are none."""
    shutil.copy(authority.ca, tmp_path / "ca.pem")
    shutil.copy(panel[0], tmp_path / "panel.pem")
    shutil.copy(panel[1], tmp_path / "panel.key")
    (tmp_path / "text.pem").write_text("text\n")
    return tmp_path


ALLOW = ("--bind", "127.0.0.1:0", "--allow", "127.0.0.0/8")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("--device-ca none.pem", "none.pem' does not exist"),
        ("--device-ca text.pem", "text.pem: found no certificate"),
        ("--device-ca .", "is a directory"),
        ("--device-cert panel.pem", "--device-cert requires --device-key."),
        ("--device-key panel.key", "--device-key requires --device-cert."),
        ("--device-cert panel.pem --device-key text.pem", "text.pem: found no"),
        ("--device-cert ca.pem --device-key panel.key", "panel.key"),
    ],
)
def test_files_that_can_not_be_used_are_told_at_start(
    files: Path, monkeypatch: pytest.MonkeyPatch, given: str, says: str
) -> None:
    monkeypatch.chdir(files)
    assert says in usage_error("gateway", *ALLOW, *given.split())


def test_a_file_that_breaks_later_is_no_fault_of_the_caller(
    files: Path, device: Relay, log: web.Records
) -> None:
    ca = files / "ca.pem"
    good = ca.read_text()
    with gateways.running(tls=Tls(ca=str(ca))) as running:
        ca.write_text("text\n")
        reason, said = failure(running.ask("/read", at(device)))
        assert (reason, str(files) in said) == ("internal_error", False)
        assert "found no certificate" in log.of("tls_unusable")[0]["error"]
        ca.write_text(good)
        assert running.ask("/read", at(device)).status == 200


def test_a_renewed_file_needs_no_restart(
    files: Path, device: Relay, authority: Authority, stranger: Authority
) -> None:
    ca = files / "ca.pem"
    shutil.copy(stranger.ca, ca)
    with gateways.running(tls=Tls(ca=str(ca))) as running:
        assert failure(running.ask("/read", at(device)))[0] == "tls_failed"
        shutil.copy(authority.ca, ca)
        assert running.ask("/read", at(device)).status == 200
        ca.unlink()
        assert running.ask("/read", at(device)).status == 200


CONFIGURATION = """\
gateway:
  bind: 127.0.0.1:0
  sources: [127.0.0.0/8]
  allow: ["127.0.0.0/8:*"]
  access: read-only
  tokens: none
"""


def test_a_configuration_has_them_too(
    files: Path, behind: tuple[str, int], authority: Authority, plc: Owner
) -> None:
    file = files / "plant.yaml"
    file.write_text(
        CONFIGURATION
        + "  device_tls: {ca_file: ca.pem, cert_file: panel.pem, key_file: panel.key}\n"
    )
    asking = context(plc, asks=authority.ca)
    with Relay(behind, asking) as relay, Appliance(load(file)) as appliance:
        [served] = appliance.endpoints()
        assert served.port is not None
        client = web.Client((served.host, served.port))
        answer = client.ask("POST", "/api/modbus/read", at(relay))
        client.close()
    assert answer.json["values"] == [11, 22, 33]


@pytest.mark.parametrize(
    ("tls", "problem"),
    [
        ("ca_file: none.pem", "device_tls.ca_file: found 'none.pem', which can't be read: No such "
         "file or directory"),
        ("cert_file: panel.pem", "device_tls.cert_file: found without key_file, allowed: both or "
         "neither"),
        ("name: plc", "device_tls.name: unknown key, allowed: ca_file, cert_file, key_file"),
        ("ca_file: text.pem", "device_tls: {folder}/text.pem: found no certificate, allowed: a "
         "certificate in PEM"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_them_is_told_with_its_place(
    files: Path, tls: str, problem: str
) -> None:
    file = files / "plant.yaml"
    file.write_text(f"{CONFIGURATION}  device_tls: {{{tls}}}\n")
    for command in ("check", "run"):
        result = CliRunner().invoke(main, [command, str(file)])
        assert result.exit_code == 2
        told = f"{file}:7: gateway.{problem.format(folder=files)}"
        assert result.stderr.splitlines() == [told, "1 problem"]


def test_a_file_that_breaks_before_the_start_is_told_by_the_appliance(files: Path) -> None:
    file = files / "plant.yaml"
    file.write_text(f"{CONFIGURATION}  device_tls: {{ca_file: ca.pem}}\n")
    config = load(file)
    (files / "ca.pem").write_text("text\n")
    with pytest.raises(OSError, match=r"gateway\.device_tls: .*ca\.pem: found no certificate"):
        Appliance(config).start()
