"""Commands: values that are written to devices, and those that are not."""

from __future__ import annotations

import struct
import threading
from typing import TYPE_CHECKING, Any

import pytest
from nats.errors import NoRespondersError

from holdfast.scanner import service
from holdfast.scanner.commands import register_value
from holdfast.scanner.errors import Refused
from holdfast.scanner.subscriptions.request_rules import ScannerLimits
from holdfast.scanner.subscriptions.tag import ScannedTag
from support import wire
from support.fake_device import FakeDevice, exception, registers
from support.nats_bus import Caller, leaving, subscription, tag

if TYPE_CHECKING:
    import holdfast
    from support.brokers import NatsServer
    from support.nats_bus import Run


@pytest.fixture(autouse=True)
def scanner(run_scanner: Run) -> None:
    run_scanner(limits=ScannerLimits(command=100))


def functions(server: holdfast.Server) -> dict[int, int]:
    counters = server.counters()
    assert "requests" in counters
    return {code: count for code, count in counters["requests"].items() if code > 4}


@pytest.mark.parametrize(
    ("kind", "text", "written", "function"),
    [
        ("int16", "-2", [65534], 6),
        ("uint16", "65535", [65535], 6),
        ("uint16", " 12.0\n", [12], 6),
        ("uint16", "1.2e3", [1200], 6),
        ("boolean", "true", [1], 6),
        ("boolean", "0", [0], 6),
        ("float16", "1.5", [0x3E00], 6),
        ("bcd16", "1234", [0x1234], 6),
        ("int32", "-2", [65535, 65534], 16),
        ("uint32", "4294967295", [65535, 65535], 16),
        ("float32", "12.5", [0x4148, 0], 16),
        ("float64", "-0.5", [0xBFE0, 0, 0, 0], 16),
        ("int64", "-9223372036854775808", [0x8000, 0, 0, 0], 16),
        ("uint64", "18446744073709551615", [65535] * 4, 16),
        ("bcd32", "12345678", [0x1234, 0x5678], 16),
        ("string:4", "AB", [0x4142, 0], 16),
        ("bytes:4", "AQIDBA==", [0x0102, 0x0304], 16),
        ("uint16[3]", "[1, 2, 3]", [1, 2, 3], 16),
        ("bit:3", "1", [8], 22),
    ],
)
def test_a_value_is_written_as_its_type_wants(
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    kind: str,
    text: str,
    written: list[int],
    function: int,
) -> None:
    request = subscription(server, tag("a", 10, kind, writable=True), scanRate=60_000)
    assert caller.request("modbus.subscribe", request)["success"]
    assert caller.request("modbus.command.a", text) == {"success": True}
    assert memory.read("holding_registers", 10, len(written)) == written
    assert functions(server) == {function: 1}


@pytest.mark.parametrize(("order", "registers"), [("CDAB", [0, 0x4148]), ("DCBA", [0, 0x4841])])
def test_a_value_is_written_in_the_order_of_its_tag(
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    order: str,
    registers: list[int],
) -> None:
    tags = [tag("a", 10, "float32", writable=True)]
    caller.request("modbus.subscribe", subscription(server, *tags, byteOrder=order))
    assert caller.request("modbus.command.a", "12.5")["success"]
    assert memory.read("holding_registers", 10, 2) == registers


@pytest.mark.parametrize(("text", "bit"), [("true", 1), ("1", 1), ("false", 0), ("0", 0)])
def test_a_coil_is_written(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, text: str, bit: int
) -> None:
    memory.write("coils", 3, [1 - bit])
    request = subscription(server, tag("a", 3, "boolean", functionCode="coil", writable=True))
    caller.request("modbus.subscribe", request)
    assert caller.request("modbus.command.plc1.a", text) == {"success": True}
    assert memory.read("coils", 3, 1) == [bit]
    assert functions(server) == {5: 1}


@pytest.mark.parametrize(
    "text", ["True", "TRUE", "False", "on", "off", "yes", "2", "1.0", "01", "", " ", " true", "1\n"]
)
def test_a_coil_takes_no_other_word_for_true_or_false(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, text: str
) -> None:
    memory.write("coils", 3, [0, 1])
    coil = {"datatype": "boolean", "functionCode": "coil"}
    tags = [tag("off", 3, **coil), tag("on", 4, **coil)]
    caller.request("modbus.subscribe", subscription(server, *tags, scanRate=60_000))
    for name in ("off", "on"):
        assert caller.request(f"modbus.command.{name}", text) == {
            "success": False,
            "error": f"{text!r} is not a valid boolean, allowed: true, false, 1 and 0",
        }
    assert memory.read("coils", 3, 2) == [0, 1]
    assert functions(server) == {}


@pytest.mark.parametrize(
    ("kind", "text", "error"),
    [
        ("int16", "32768", "32768 is outside -32768 to 32767 of int16"),
        ("uint16", "-1", "-1 is outside 0 to 65535 of uint16"),
        ("uint16", "12.5", "'12.5' is not a valid uint16"),
        ("uint16", "true", "'true' is not a valid uint16, allowed: a JSON number"),
        ("uint16", "0x10", "'0x10' is not a valid uint16"),
        ("uint16", "1e999", "'1e999' is not a valid uint16"),
        ("uint16", "", "'' is not a valid uint16"),
        ("uint16", "١", "is not a valid uint16"),
        ("boolean", "2", "'2' is not a valid boolean, allowed: true, false, 1 and 0"),
        ("boolean", "on", "'on' is not a valid boolean"),
        ("float32", "nan", "'nan' is not a valid float32"),
        ("float32", "inf", "'inf' is not a valid float32"),
        ("float32", "1e39", "float32"),
        ("float64", "1e999", "'1e999' does not fit float64"),
        ("bcd16", "10000", "bcd16"),
        ("string:4", "ABCDE", "string:4"),
        ("string:4", "ü", "can't be encoded in ascii"),
        ("bytes:4", "AQI", "'AQI' is not a valid bytes:4, allowed: base64"),
        ("bytes:4", "AQI=", "bytes:4"),
        ("uint16[2]", "[1]", "uint16[2]"),
        ("uint16[2]", "1", "'1' is not a valid uint16[2], allowed: a JSON array"),
        ("uint16[2]", "[1, 70000]", "70000"),
    ],
)
def test_a_value_that_the_type_can_not_hold_is_refused(
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    kind: str,
    text: str,
    error: str,
) -> None:
    request = subscription(server, tag("a", 10, kind, writable=True), scanRate=60_000)
    assert caller.request("modbus.subscribe", request)["success"]
    answer = caller.request("modbus.command.a", text)
    assert answer["success"] is False
    assert error in answer["error"]
    assert memory.read("holding_registers", 10, 4) == [0] * 4
    assert functions(server) == {}


def test_what_is_not_writable_is_not_written(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    tags = [tag("a", 0, writable=False), tag("b", 1, functionCode="input")]
    caller.request("modbus.subscribe", subscription(server, *tags))
    reasons = {"a": 'hmi set "writable": false', "b": "functionCode input is not writable"}
    for name, reason in reasons.items():
        answer = caller.request(f"modbus.command.{name}", "1")
        assert answer["error"] == f"tag {name!r} of plc1 is not writable: {reason}"
    unknown = caller.request("modbus.command.c", "1")
    assert unknown["error"] == "no tag 'c'"
    long = caller.request("modbus.command.a", "1" * 101)
    assert long["error"] == "the value has 101 bytes, allowed: 100"
    assert caller.request("modbus.command.a", b"\xff")["error"] == "the value is not UTF-8 text"

    # A subscriber that leaves it out does not change it, one that declares it writable does.
    reader = subscription(server, tag("a", 0), subscriberId="reader")
    assert caller.request("modbus.subscribe", reader)["success"]
    assert not caller.request("modbus.command.a", "4")["success"]
    writer = subscription(server, tag("a", 0, writable=True), subscriberId="operator")
    assert caller.request("modbus.subscribe", writer)["success"]
    assert caller.request("modbus.command.a", "5")["success"]
    caller.request("modbus.unsubscribe", leaving("a", subscriberId="operator"))
    assert not caller.request("modbus.command.a", "6")["success"]
    assert memory.read("holding_registers", 0, 2) == [5, 0]


def test_a_tag_that_two_devices_have_is_commanded_by_both_names(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    for number, id in enumerate(("plc1", "plc2", "plc1.a")):
        tags = [tag("a.b" if id == "plc1" else "b", number, writable=True), tag("x", 9)]
        caller.request("modbus.subscribe", subscription(server, *tags, deviceId=id))
    ambiguous = caller.request("modbus.command.b", "1")
    assert ambiguous["error"] == "'b' is ambiguous: plc1.a.b, plc2.b"
    # Tag a.b of plc1, or tag b of plc1.a.
    assert "is ambiguous" in caller.request("modbus.command.plc1.a.b", "1")["error"]
    assert memory.read("holding_registers", 0, 3) == [0, 0, 0]
    assert caller.request("modbus.command.plc2.b", "2")["success"]
    assert caller.request("modbus.command.a.b", "3")["success"]
    assert memory.read("holding_registers", 0, 3) == [3, 2, 0]


def test_no_tag_has_a_name_of_more_characters_than_its_ids(
    caller: Caller, server: holdfast.Server
) -> None:
    """Each dot may separate device and tag: a subject of 4 KiB would hold up other requests."""
    device, id = "d" + 63 * ".d" + "d", "t" + 127 * ".t" + "t"
    request = subscription(server, tag(id, 0, writable=True), deviceId=device)
    assert caller.request("modbus.subscribe", request)["success"]
    assert caller.request(f"modbus.command.{device}.{id}", "1")["success"]
    answer = caller.request(f"modbus.command.{device}.{id}.t", "1")
    assert answer["error"] == "no tag has a name of 387 characters"


def test_a_message_that_is_refused_is_logged(
    caller: Caller,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caller.request("modbus.subscribe", subscription(server, tag("a", 0, writable=False)))
    caller.publish("modbus.command.a", "7")

    def logged() -> bool:
        return any(
            record.getMessage() == "request_refused"
            and record.fields["subject"] == "modbus.command.a"  # type: ignore[attr-defined]
            and "not writable" in record.fields["reason"]  # type: ignore[attr-defined]
            for record in caplog.records
        )

    wire.until(logged, "it is logged")
    assert not any("=7" in str(vars(record)) for record in caplog.records)


def test_a_write_is_answered_when_the_device_has_confirmed_it(caller: Caller) -> None:
    written, confirm = threading.Event(), threading.Event()

    def answer(pdu: bytes) -> bytes:
        if pdu[0] == 6:
            written.set()
            assert confirm.wait(wire.DEADLINE)
            return pdu
        return registers(pdu)

    def device(pdu: bytes) -> bytes:
        return answer(pdu)

    answered: list[Any] = []
    with FakeDevice(device) as plc:
        request = {
            "deviceId": "plc1",
            "subscriberId": "x",
            "url": plc.url,
            "timeout": 10_000,
            "scanRate": 60_000,
            "tags": [tag("a", 0, writable=True)],
        }
        data = caller.listen("modbus.data.plc1")
        assert caller.request("modbus.subscribe", request)["success"]
        data.next()
        asking = threading.Thread(
            target=lambda: answered.append(caller.request("modbus.command.a", "1"))
        )
        asking.start()
        assert written.wait(wire.DEADLINE)
        assert answered == []
        confirm.set()
        asking.join()
        assert answered == [{"success": True}]
        caller.request("modbus.unsubscribe", leaving("a", subscriberId="x"))


@pytest.mark.parametrize("is_confirmed", [True, False])
def test_a_command_is_answered_while_the_scanner_stops(
    own_nats: NatsServer,
    run_scanner: Run,
    monkeypatch: pytest.MonkeyPatch,
    is_confirmed: bool,
) -> None:
    written, go_on = threading.Event(), threading.Event()

    def answer(pdu: bytes) -> bytes:
        if pdu[0] == 6:
            written.set()
            assert go_on.wait(wire.DEADLINE)
            return pdu
        return registers(pdu)

    def takes_nothing(caller: Caller) -> bool:
        try:
            caller.request("modbus.browse", "")
        except NoRespondersError:
            return True
        return False

    if not is_confirmed:
        monkeypatch.setattr(service, "REQUESTS_TIMEOUT_S", 0.01)
    answered: list[Any] = []
    scanner = run_scanner(own_nats)
    with FakeDevice(answer) as plc, Caller(own_nats.url) as caller:
        request = {
            "deviceId": "plc1",
            "subscriberId": "x",
            "url": plc.url,
            "timeout": 30_000,
            "scanRate": 60_000,
            "tags": [tag("a", 0, writable=True)],
        }
        assert caller.request("modbus.subscribe", request)["success"]
        asking = threading.Thread(
            target=lambda: answered.append(caller.request("modbus.command.a", "1"))
        )
        asking.start()
        assert written.wait(wire.DEADLINE)
        stopping = threading.Thread(target=scanner.stop)
        stopping.start()
        wire.until(lambda: takes_nothing(caller), "it takes no further requests")
        if not is_confirmed:
            asking.join()
        go_on.set()
        asking.join()
        stopping.join()
    said = {"success": False, "error": "not confirmed: the scanner is stopping"}
    assert answered == [{"success": True} if is_confirmed else said]


def test_what_the_device_refuses_is_told(caller: Caller, caplog: pytest.LogCaptureFixture) -> None:
    def answer(pdu: bytes) -> bytes:
        return exception(pdu, pdu[4]) if pdu[0] == 6 else registers(pdu)

    with FakeDevice(answer) as plc:
        request = {
            "deviceId": "plc1",
            "subscriberId": "x",
            "url": plc.url,
            "scanRate": 60_000,
            "tags": [tag("a", 0, writable=True)],
        }
        data = caller.listen("modbus.data.plc1")
        caller.request("modbus.subscribe", request)
        data.next()
        for code, error in (
            ("2", "not written: exception 02 (Illegal Data Address)"),
            ("4", "not confirmed: exception 04 (Server Device Failure)"),
            ("99", "not confirmed: exception 63"),
        ):
            assert caller.request("modbus.command.a", code) == {"success": False, "error": error}
        caller.request("modbus.unsubscribe", leaving("a", subscriberId="x"))
    logged = [vars(each)["fields"] for each in caplog.records if each.msg == "request_refused"]
    outcomes = [each.get("outcome") for each in logged]
    assert outcomes == [None, "not_confirmed", "not_confirmed"]


def test_commands_for_one_device_are_carried_out_in_order(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    caller.request("modbus.subscribe", subscription(server, tag("a", 0, writable=True)))
    for number in range(200):
        caller.publish("modbus.command.a", str(number))
    assert caller.request("modbus.command.a", "1000")["success"]
    assert memory.read("holding_registers", 0, 1) == [1000]
    assert functions(server) == {6: 201}


def test_a_number_is_exact() -> None:
    def of(kind: str) -> ScannedTag:
        return ScannedTag("a", "holding_registers", 0, kind, "ABCD", frozenset())

    assert register_value("9007199254740993", of("int64")) == 2**53 + 1
    assert register_value("0.1", of("float64")) == 0.1
    assert struct.pack(">f", register_value("0.1", of("float32"))) == struct.pack(">f", 0.1)
    with pytest.raises(Refused):
        register_value("1e999999999", of("int64"))
