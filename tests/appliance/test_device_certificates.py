"""Renewed client certificates for devices: a reload has them presented at the next connection."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.appliance import Appliance
from holdfast.config import load
from support import web, wire
from support.config_folder import written
from support.nats_bus import tag
from support.running import endpoint
from support.secured import Authority, Relay, context

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.brokers import NatsServer
    from support.nats_bus import Caller
    from support.running import Serve

NAMES = "DNS:localhost,IP:127.0.0.1"
READ = bytes.fromhex("0300000001")


class Owned:
    """The client certificate of an appliance, and a device that only trusts that of another."""

    def __init__(self, folder: Path, to: tuple[str, int]) -> None:
        self.ca = Authority(folder, "devices")
        before, after = (Authority(folder, name) for name in ("before", "after"))
        self.files = folder / "own.pem", folder / "own.key"
        self._outdated = before.issue("client", NAMES)
        self._renewed = after.issue("client", NAMES)
        self._install(self._outdated)
        self.device = Relay(to, context(self.ca.issue("plc", NAMES), asks=after.ca))

    def renew(self) -> None:
        """Writes the certificate that the device trusts."""
        self._install(self._renewed)

    def _install(self, issued: Any) -> None:
        for source, file in zip(issued, self.files, strict=False):
            shutil.copy(source, file)

    @property
    def url(self) -> str:
        cert, key = self.files
        return self.device.url(ca=self.ca.ca, cert=cert, key=key)

    @property
    def device_tls(self) -> dict[str, str]:
        cert, key = map(str, self.files)
        return {"ca_file": str(self.ca.ca), "cert_file": cert, "key_file": key}


@pytest.fixture
def owned(tmp_path: Path, serve: Serve) -> Iterator[Owned]:
    memory = holdfast.Memory(holding_registers=10)
    memory.write("holding_registers", 0, [42])
    made = Owned(tmp_path, serve({1: memory}).address)
    with made.device:
        yield made


class Rig:
    """A running appliance with one configuration, which can be loaded again."""

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self._file = folder / "plant.yaml"
        self._file.write_text(written(settings))
        self.appliance = Appliance(load(self._file)).start()

    def reload(self) -> list[str]:
        return self.appliance.reload(load(self._file))


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Any]:
    rigs: list[Rig] = []

    def started(settings: dict[str, Any]) -> Rig:
        rigs.append(Rig(tmp_path, settings))
        return rigs[-1]

    yield started
    for rig in rigs:
        rig.appliance.stop()


def test_the_poller_presents_them(owned: Owned, start: Any) -> None:
    into = {"memory": "plant", "area": "holding_registers", "address": 5}
    read = {"area": "holding_registers", "address": 0, "count": 1, "into": into}
    device = {"url": owned.url, "interval": 0.05, "timeout": wire.DEADLINE, "reads": [read]}
    device |= {"unit": 1, "retry": {"first": 0.05, "most": 0.05}}
    rig = start({"memories": {"plant": {"holding_registers": 10}}, "devices": {"plc": device}})

    def has(health: str) -> bool:
        return bool(rig.appliance.diagnostics.stats()["devices"]["plc"]["health"] == health)

    wire.until(lambda: has("error"), "the device refuses the certificate")
    owned.renew()
    assert rig.reload() == ["devices.plc"]
    wire.until(lambda: has("ok"), "the device accepts the renewed certificate")
    assert rig.appliance.memories["plant"].read("holding_registers", 5, 1) == [42]


def test_a_link_presents_them(owned: Owned, start: Any) -> None:
    rule = {"sources": ["127.0.0.1"], "units": {1: {"route": "line"}}, "access": "read-only"}
    scada = {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": [rule]}
    link = {"url": owned.url, "timeout": wire.DEADLINE, "retry": {"first": 0.05, "most": 0.05}}
    rig = start({"links": {"line": link}, "listeners": {"scada": scada}})
    with wire.Connection(endpoint(rig.appliance, "scada")) as client:
        assert client.ask(READ)[0] == 0x83
        owned.renew()
        assert rig.reload() == ["links.line"]
        wire.until(lambda: client.ask(READ) == bytes.fromhex("0302002a"), "the device answers")


def test_the_gateway_presents_them(owned: Owned, start: Any) -> None:
    rig = start(
        {
            "gateway": {
                "bind": "127.0.0.1:0",
                "sources": ["127.0.0.0/8"],
                "allow": ["127.0.0.1:*"],
                "access": "read-only",
                "tokens": "none",
                "device_tls": owned.device_tls,
            }
        }
    )
    asked = {"host": "127.0.0.1", "port": owned.device.address[1], "transport": "tls"}
    asked |= {"functionCode": 3, "address": 0, "quantity": 1}
    content = json.dumps(asked).encode()
    request = web.head("POST", "/api/modbus/read", f"Content-Length: {len(content)}") + content

    def reply() -> bytes:
        # The gateway starts again after the reload, and closes its connections.
        try:
            with wire.Connection(endpoint(rig.appliance, "gateway")) as client:
                client.send(request)
                return client.socket.recv(65536)
        except OSError:
            return b""

    assert b"tls_failed" in reply()
    owned.renew()
    assert rig.reload() == ["gateway"]
    wire.until(lambda: b'"values":[42]' in reply(), "the device answers")


def test_the_scanner_presents_them(
    owned: Owned, start: Any, nats: NatsServer, caller: Caller
) -> None:
    rig = start(
        {
            "nats": {
                "servers": [nats.url],
                "devices": ["127.0.0.0/8"],
                "device_tls": owned.device_tls,
            }
        }
    )
    data, states = caller.listen("modbus.data.plc1"), caller.listen("modbus.status.plc1")
    asked = {"deviceId": "plc1", "subscriberId": "hmi", "scanRate": 50, "tags": [tag("a", 0)]}
    asked |= {"host": "127.0.0.1", "port": owned.device.address[1], "transport": "tls"}

    def is_connected() -> bool:
        status = rig.appliance.diagnostics.adapter("nats")
        return bool(status and status.get("connected"))

    wire.until(is_connected, "the scanner serves")
    assert caller.request("modbus.subscribe", asked)["success"]
    states.until(lambda state: state["state"] == "offline", "the device refuses the certificate")
    owned.renew()
    # The scanner starts again, and restores its subscriptions.
    assert rig.reload() == ["nats"]
    assert data.next()["value"] == 42
