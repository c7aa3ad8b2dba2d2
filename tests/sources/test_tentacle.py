"""Each literal message of the readme of tentacle-modbus, as `JSON.stringify` sends it.

The host of a request is that of a server of the test; everything else is as printed.
"""

from __future__ import annotations

import struct
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

from support import wire
from support.pymodbus_server import Pymodbus
from support.tentacle import text

if TYPE_CHECKING:
    from collections.abc import Iterator

    import holdfast
    from support.nats_bus import Caller, Inbox, Run
    from support.running import Serve

FUNCTION_CODES = ["coil", "discrete", "holding", "input"]
BYTE_ORDERS = ["ABCD", "BADC", "CDAB", "DCBA"]
VALUES: dict[str, tuple[str, Any, str]] = {
    # How the registers are packed, a value, and the datatype of tentacle-plc.
    "boolean": (">H", True, "boolean"),
    "int16": (">h", -2, "number"),
    "uint16": (">H", 65534, "number"),
    "int32": (">i", -123456, "number"),
    "uint32": (">I", 4_000_000_000, "number"),
    "float32": (">f", 21.5, "number"),
    "float64": (">d", -0.1, "number"),
}
REGISTERS = {"boolean": 1, "int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "float32": 2}
REGISTERS["float64"] = 4


def words(kind: str) -> list[int]:
    """The registers of the value of a datatype, in the order ABCD."""
    packed = struct.pack(VALUES[kind][0], VALUES[kind][1])
    return list(struct.unpack(f">{len(packed) // 2}H", packed))


def device(caller: Caller, id: str) -> Any:
    [found] = caller.request("modbus.browse", {"deviceId": id})["devices"]
    return found


def messages(data: Inbox, count: int) -> dict[str, dict[str, Any]]:
    """The first messages of so many tags, by their ids."""
    found: dict[str, dict[str, Any]] = {}
    while len(found) < count:
        message = data.next()
        found.setdefault(message["variableId"], message)
    return found


def request(where: tuple[str, int], *tags: dict[str, Any], **optional: Any) -> str:
    """Builds a `ModbusSubscribeRequest`, with its keys in their order."""
    host, port = where
    return text(
        {"deviceId": "pump-skid", "host": host, "port": port}
        | optional
        | {"tags": list(tags), "subscriberId": "plc"}
    )


@pytest.mark.usefixtures("scanner")
def test_a_request_may_leave_out_what_the_type_marks_as_optional(caller: Caller) -> None:
    tag = {"id": "a", "address": 0, "functionCode": "holding", "datatype": "float32"}
    sent = {"deviceId": "pump-skid", "host": "127.0.0.1", "tags": [tag], "subscriberId": "plc"}
    assert caller.request("modbus.subscribe", text(sent)) == {"success": True, "count": 1}
    found = device(caller, "pump-skid")
    # port 502, unitId 1, byteOrder "ABCD", scanRate 1000
    assert found["url"].removesuffix(":502") == "tcp://127.0.0.1"
    assert (found["unitId"], found["scanRate"]) == (1, 1000)
    assert found["tags"][0]["byteOrder"] == "ABCD"


@pytest.mark.usefixtures("scanner")
def test_every_function_code_and_datatype_of_the_type_is_published(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    tags, expected, address = [], {}, 0
    for kind, (_, value, datatype) in VALUES.items():
        registers = words(kind)
        assert len(registers) == REGISTERS[kind]
        for area, function in (("holding_registers", "holding"), ("input_registers", "input")):
            id = f"{function}-{kind}"
            tag = {"id": id, "address": address, "functionCode": function, "datatype": kind}
            tags.append(tag | {"byteOrder": "ABCD", "writable": function == "holding"})
            expected[id] = value, datatype
            memory.write(area, address, registers)
        address += len(registers)
    for area, function in (("coils", "coil"), ("discrete_inputs", "discrete")):
        memory.write(area, 3, [1])
        tags.append({"id": function, "address": 3, "functionCode": function, "datatype": "boolean"})
        expected[function] = True, "boolean"
    data = caller.listen("modbus.data.pump-skid")
    sent = request(server.address, *tags, unitId=1, byteOrder="ABCD", scanRate=1000)
    assert caller.request("modbus.subscribe", sent) == {"success": True, "count": len(tags)}
    found = messages(data, len(tags))
    shown = {id: (each["value"], each["datatype"]) for id, each in found.items()}
    assert shown == expected
    for id, each in found.items():
        assert list(each) == [
            "moduleId",
            "deviceId",
            "variableId",
            "value",
            "datatype",
            "timestamp",
        ]
        assert (each["moduleId"], each["deviceId"], each["variableId"]) == (
            "modbus",
            "pump-skid",
            id,
        )
        assert type(each["timestamp"]) is int


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize("order", BYTE_ORDERS)
def test_a_byte_order_of_a_device_holds_unless_a_tag_has_another(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory, order: str
) -> None:
    """The letters are places of the bytes of 0x01020304, most significant first."""
    on_the_wire = bytes("ABCD".index(letter) + 1 for letter in order)
    memory.write("holding_registers", 0, list(struct.unpack(">2H", on_the_wire)))
    memory.write("holding_registers", 2, [0x0102, 0x0304])
    kind = {"functionCode": "holding", "datatype": "uint32"}
    tags = [
        {"id": "device", "address": 0, **kind, "writable": True},
        {"id": "tag", "address": 2, **kind, "byteOrder": "ABCD"},
    ]
    data = caller.listen("modbus.data.pump-skid")
    assert caller.request("modbus.subscribe", request(server.address, *tags, byteOrder=order))
    found = messages(data, 2)
    assert [found[id]["value"] for id in ("device", "tag")] == [0x01020304] * 2
    # The same arrangement encodes: the order is its own inverse.
    memory.write("holding_registers", 0, [0, 0])
    caller.publish("modbus.command.device", str(0x01020304))
    wire.until(lambda: memory.read("holding_registers", 0, 2) != [0, 0], "it is written")
    assert struct.pack(">2H", *memory.read("holding_registers", 0, 2)) == on_the_wire


@pytest.mark.usefixtures("scanner")
def test_holding_register_40001_of_a_data_sheet_is_address_0(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [4711, 1])
    data = caller.listen("modbus.data.pump-skid")
    tag = {"id": "a", "address": 0, "functionCode": "holding", "datatype": "uint16"}
    caller.request("modbus.subscribe", request(server.address, tag))
    assert data.next()["value"] == 4711


def test_pauses_begin_again_after_a_successful_connect(
    run_scanner: Run, caller: Caller, serve: Serve, memory: holdfast.Memory
) -> None:
    running = run_scanner(exact_pauses_s=(0.01, 0.04))
    server = serve({1: memory})
    host, port = server.address
    tag = {"id": "a", "address": 0, "functionCode": "holding", "datatype": "uint16"}
    caller.request("modbus.subscribe", request(server.address, tag, scanRate=50))
    for _ in range(2):
        wire.until(lambda: device(caller, "pump-skid")["state"] == "online", "it is connected")
        assert device(caller, "pump-skid")["failures"] == 0
        server.stop()
        wire.until(lambda: device(caller, "pump-skid")["failures"] > 3, "it is tried again")
        server = serve({1: memory}, bind=f"{host}:{port}")
    running.stop()


@contextmanager
def pymodbus_server() -> Iterator[tuple[str, int]]:
    """What `scripts/pymodbus_server.py` is there: a server of another project."""
    server = Pymodbus("tcp")
    try:
        host, _, port = server.url.removeprefix("tcp://").rpartition(":")
        yield host, int(port)
    finally:
        server.stop()


@pytest.mark.usefixtures("scanner")
def test_a_server_of_pymodbus_is_polled_and_written(caller: Caller) -> None:
    data = caller.listen("modbus.data.pump-skid")
    tags = [
        {"id": "flag", "address": 3, "functionCode": "discrete", "datatype": "boolean"},
        {"id": "count", "address": 7, "functionCode": "input", "datatype": "uint16"},
        {"id": "level", "address": 10, "functionCode": "holding", "datatype": "float32"},
        {"id": "run", "address": 2, "functionCode": "coil", "datatype": "boolean"},
    ]
    with pymodbus_server() as where:
        caller.request("modbus.subscribe", request(where, *tags, scanRate=50))
        found = messages(data, len(tags))
        assert {id: each["value"] for id, each in found.items()} == {
            "flag": True,
            "count": 7,
            "level": 0,
            "run": False,
        }
        caller.publish("modbus.command.level", "21.5")
        caller.publish("modbus.command.run", "true")
        data.until(lambda each: each["value"] == 21.5, "the level is written")
        data.until(lambda each: each["variableId"] == "run" and each["value"], "the coil is on")
        left = {"deviceId": "pump-skid", "tagIds": [tag["id"] for tag in tags]}
        left["subscriberId"] = "plc"
        assert caller.request("modbus.unsubscribe", text(left)) == {"success": True}
