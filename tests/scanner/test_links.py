"""Commands go over the connection that a device is scanned by, whatever it is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from support import lines, wire
from support.fake_device import FakeDevice, registers
from support.lines import RTU, UNIT, Cable
from support.nats_bus import leaving, subscription, tag
from support.polled import Fake, data, reply

if TYPE_CHECKING:
    from pathlib import Path

    import holdfast
    from support import nats_bus
    from support.nats_bus import Caller
    from support.running import Run


def device(url: str, **more: Any) -> dict[str, Any]:
    tags = [tag("a", 0, writable=True), tag("b", 1)]
    return {"deviceId": "plc1", "subscriberId": "x", "url": url, "tags": tags} | more


def test_scans_and_commands_share_one_connection(
    run_scanner: nats_bus.Run, caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    run_scanner()
    request = subscription(server, tag("a", 0, writable=True), scanRate=100)
    assert caller.request("modbus.subscribe", request)["success"]
    for number in range(50):
        assert caller.request("modbus.command.a", str(number)) == {"success": True}
    assert memory.read("holding_registers", 0, 1) == [49]
    counters = server.counters()
    assert "connections" in counters
    assert counters["connections"]["accepted"] == 1


def test_a_device_with_one_connection_that_is_released_takes_commands(
    run_scanner: nats_bus.Run, caller: Caller
) -> None:
    """The fake device accepts the next connection when the one before has ended."""
    run_scanner()
    with FakeDevice(lambda pdu: pdu if pdu[0] == 6 else registers(pdu)) as plc:
        request = device(plc.url, scanRate=100, release=True)
        assert caller.request("modbus.subscribe", request)["success"]
        for number in range(20):
            assert caller.request("modbus.command.a", str(number)) == {"success": True}
        assert [pdu[3:] for pdu in plc.asked if pdu[0] == 6] == [
            number.to_bytes(2) for number in range(20)
        ]
        caller.request("modbus.unsubscribe", leaving("a", "b", subscriberId="x"))


def test_a_device_gets_one_request_at_a_time(run_scanner: nats_bus.Run, caller: Caller) -> None:
    """Each answer waits for the next request, as long as that could be under way."""
    together: list[int] = []

    def answer(request: wire.Frame) -> bytes:
        together.append(len(fake.requests))
        return reply(request, request.pdu) if request.pdu[0] == 6 else data(request)

    run_scanner()
    with Fake(answer) as fake:
        request = device(fake.url, scanRate=100, plan={"max_gap": 0, "max_registers": 1})
        assert caller.request("modbus.subscribe", request)["success"]
        for number in range(100):
            caller.publish("modbus.command.a", str(number))
        assert caller.request("modbus.command.a", "100")["success"]
        written = [request.pdu for request in fake.requests if request.pdu[0] == 6]
        assert [pdu[3:] for pdu in written] == [number.to_bytes(2) for number in range(101)]
        assert together == list(range(1, len(together) + 1))
        assert fake.connections == 1
        caller.request("modbus.unsubscribe", leaving("a", "b", subscriberId="x"))


def test_a_device_on_a_serial_line_is_scanned_and_written(
    run_scanner: nats_bus.Run, caller: Caller, run: Run, tmp_path: Path
) -> None:
    with Cable(tmp_path) as cable:
        served, scanned = cable.devices
        memory = run(lines.configuration(RTU, served)).memories["plant"]
        run_scanner(allow=(str(scanned),))
        heard = caller.listen("modbus.data.plc1")
        url = f"rtu://{scanned}?parity=none&baud=115200"
        request = device(url, unitId=UNIT, scanRate=100)
        assert caller.request("modbus.subscribe", request)["success"]
        assert caller.request("modbus.command.a", "4711") == {"success": True}
        assert memory.read("holding_registers", 0, 1) == [4711]
        heard.until(lambda each: (each["variableId"], each["value"]) == ("a", 4711), "read back")
        caller.request("modbus.unsubscribe", leaving("a", "b", subscriberId="x"))


def test_a_command_tries_a_device_that_is_given_a_rest(
    run_scanner: nats_bus.Run, caller: Caller
) -> None:
    """After the first failures the pause of the address is longer than any test waits."""
    run_scanner()
    states = caller.listen("modbus.status.plc1")
    fake = Fake(lambda each: reply(each, each.pdu) if each.pdu[0] == 6 else data(each))
    request = device(fake.url, scanRate=100)
    assert caller.request("modbus.subscribe", request)["success"]
    states.until(lambda each: each["state"] == "offline", "it is down")
    for _ in range(6):
        refused = caller.request("modbus.command.a", "1")
        assert refused == {"success": False, "error": "not written: no connection"}
    with fake:
        assert caller.request("modbus.command.a", "2") == {"success": True}
        caller.request("modbus.unsubscribe", leaving("a", "b", subscriberId="x"))
