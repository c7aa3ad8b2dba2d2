"""The scanner of an appliance: it shares connections, and manages only its own devices."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest

from support import wire
from support.fake_device import Stream
from support.nats_bus import leaving, subscription, tag
from support.running import endpoint
from support.scanner_parts import polling_of, presence_of
from support.shared import Careful, polled, read, with_gateway

if TYPE_CHECKING:
    import holdfast
    from holdfast.appliance import Appliance
    from support.brokers import NatsServer
    from support.nats_bus import Caller
    from support.running import Connect, Run

PREFIX = "shared"


def configuration(nats: NatsServer, url: str, **more: Any) -> str:
    section = {"servers": [nats.url], "devices": ["127.0.0.0/8"], "prefix": PREFIX}
    return with_gateway(url, nats=section, **more)


def status(appliance: Appliance) -> dict[str, Any]:
    found = appliance.diagnostics.adapter("nats")
    assert found is not None
    return found


def until_connected(appliance: Appliance) -> None:
    wire.until(lambda: status(appliance).get("connected"), "the scanner is connected")


def wanted(device: Stream, *tags: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {
        "deviceId": "plc1",
        "subscriberId": "hmi",
        "url": device.url,
        "scanRate": 50,
        "tags": list(tags),
        **more,
    }


def connections(server: holdfast.Server) -> Any:
    counters: Any = server.counters()
    return counters["connections"]


def test_all_that_uses_a_device_shares_its_only_connection(
    run: Run, nats: NatsServer, caller: Caller, connect: Connect
) -> None:
    careful = Careful()
    with Stream("tcp", then=careful, in_turn=True) as device, ThreadPoolExecutor(8) as threads:
        appliance = run(configuration(nats, device.url, **polled(device.url)))
        until_connected(appliance)
        data = caller.listen(f"{PREFIX}.data.plc1")
        request = wanted(device, tag("a", 20), tag("b", 21, writable=True))
        assert caller.request(f"{PREFIX}.subscribe", request)["success"]
        front = connect(endpoint(appliance, "scada"))
        asked = [threads.submit(read, appliance, device.port, 100 + number) for number in range(40)]
        for number in range(200, 240):
            assert front.ask(b"\3" + number.to_bytes(2) + b"\0\1")[2:] == number.to_bytes(2)
            command = caller.request(f"{PREFIX}.command.b", str(number + 1000))
            assert command == {"success": True}
        answers = [each.result().json["values"] for each in asked]
        assert answers == [[100 + number] for number in range(40)]
        data.until(lambda each: (each["variableId"], each["value"]) == ("a", 20), "tag a")
        data.until(lambda each: (each["variableId"], each["value"]) == ("b", 1239), "tag b")
        memory = appliance.memories["plant"]
        wire.until(lambda: memory.read("holding_registers", 9, 1) == [9], "it is polled")
        assert (device.connections, careful.overlaps) == (1, 0)
        caller.request(f"{PREFIX}.unsubscribe", leaving("a", "b"))


def test_devices_of_the_scanner_are_not_those_of_the_configuration(
    run: Run, nats: NatsServer, caller: Caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0)
    with Stream("tcp") as device, Stream("tcp") as other:
        appliance = run(configuration(nats, device.url, **polled(device.url)))
        until_connected(appliance)
        data = caller.listen(f"{PREFIX}.data.meter")
        request = wanted(other, tag("a", 5), deviceId="meter")
        assert caller.request(f"{PREFIX}.subscribe", request)["success"]
        assert data.next()["value"] == 5
        assert list(appliance.diagnostics.stats()["devices"]) == ["meter"]
        assert appliance.diagnostics.stats()["devices"]["meter"]["exceptions"] == 0
        [report] = caller.request(f"{PREFIX}.browse", {})["devices"]
        assert report["deviceId"] == "meter"
        appliance.log_events(0)


def test_a_scanner_that_ends_stops_its_devices_and_no_others(
    run: Run, nats: NatsServer, caller: Caller, server: holdfast.Server
) -> None:
    with Stream("tcp") as device:
        appliance = run(configuration(nats, device.url, **polled(device.url)))
        until_connected(appliance)
        data = caller.listen(f"{PREFIX}.data.plc1")
        request = subscription(server, tag("a", 5))
        assert caller.request(f"{PREFIX}.subscribe", request)["success"]
        assert data.next()["value"] == 0
        caller.publish(f"{PREFIX}.shutdown")
        wire.until(lambda: status(appliance)["state"] == "stopped", "the scanner has ended")
        wire.until(lambda: connections(server)["open"] == 0, "its connection is closed")
        before = len(device.requests)
        wire.until(lambda: len(device.requests) > before + 3, "the configured device is polled")


def test_a_scanner_that_failed_continues_with_the_same_devices(
    run: Run, nats: NatsServer, caller: Caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.appliance.services.supervision.FIRST_PAUSE_S", 0.01)
    with Stream("tcp", in_turn=True) as device:
        appliance = run(configuration(nats, device.url, **polled(device.url)))
        until_connected(appliance)
        data = caller.listen(f"{PREFIX}.data.plc1")
        request = wanted(device, tag("a", 20))
        assert caller.request(f"{PREFIX}.subscribe", request)["success"]
        assert data.next()["value"] == 20
        supervisor = appliance.diagnostics.adapters["nats"]
        scanner: Any = supervisor._adapter
        service = scanner._scanner

        async def broken(_: object) -> None:
            raise RuntimeError("broken by the test")

        presence = presence_of(service)
        monkeypatch.setattr(presence.heartbeat, "beat", broken)
        polling_of(service)._loop.call_soon_threadsafe(presence.beat_soon)
        wire.until(lambda: status(appliance)["restarts"] == 1, "it is restarted")
        until_connected(appliance)
        data.take()
        assert caller.request(f"{PREFIX}.subscribe", request)["success"]
        assert data.next()["value"] == 20
        assert device.connections == 1
        caller.request(f"{PREFIX}.unsubscribe", leaving("a"))


def test_the_gateway_shares_a_device_that_only_the_scanner_uses(
    run: Run, nats: NatsServer, caller: Caller
) -> None:
    with Stream("tcp") as configured, Stream("tcp", in_turn=True) as device:
        appliance = run(configuration(nats, configured.url))
        until_connected(appliance)
        assert read(appliance, device.port, 7).json["values"] == [7]
        data = caller.listen(f"{PREFIX}.data.plc1")
        request = wanted(device, tag("a", 5), timeout=30_000)
        assert caller.request(f"{PREFIX}.subscribe", request)["success"]
        assert data.next()["value"] == 5
        assert read(appliance, device.port, 7).json["values"] == [7]
        assert device.connections == 2, "the gateway has given up the connection of its own"
        caller.request(f"{PREFIX}.unsubscribe", leaving("a"))


def test_a_device_that_is_configured_by_its_name_is_shared(
    run: Run, nats: NatsServer, caller: Caller
) -> None:
    with Stream("tcp", in_turn=True) as device:
        url = f"tcp://localhost:{device.port}"
        appliance = run(configuration(nats, url, **polled(url)))
        wire.until(lambda: device.requests, "it is polled")
        until_connected(appliance)
        data = caller.listen(f"{PREFIX}.data.plc1")
        request = wanted(device, tag("a", 20), url=url)
        assert caller.request(f"{PREFIX}.subscribe", request)["success"]
        assert data.next()["value"] == 20
        assert device.connections == 1
        caller.request(f"{PREFIX}.unsubscribe", leaving("a"))
