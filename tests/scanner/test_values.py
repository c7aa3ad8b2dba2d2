"""What is published: every type and order, values that mean nothing, changes and deadbands."""

from __future__ import annotations

import base64
import json
import math
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.values.types import parsed
from support import wire
from support.nats_bus import subscription, tag
from support.paths import VECTORS

if TYPE_CHECKING:
    import holdfast
    from support.nats_bus import Caller, Inbox

pytestmark = pytest.mark.usefixtures("scanner")

CASES = json.loads((VECTORS / "values.json").read_text())["cases"]


def first_values(data: Inbox, count: int) -> dict[str, Any]:
    """The first message of each of so many tags."""
    found: dict[str, Any] = {}
    while len(found) < count:
        message = data.next()
        found.setdefault(message["variableId"], message)
    return found


def as_json(value: Any, type: str) -> Any:
    """A value of the vectors as it is published."""
    if isinstance(value, list):
        return [as_json(item, type) for item in value]
    if type.startswith("bytes"):
        return base64.b64encode(bytes.fromhex(value)).decode()
    if isinstance(value, str) and parsed(type).base.startswith("float"):
        return None  # NaN and infinities, which JSON does not have.
    return value


def test_every_type_in_every_order_of_the_vectors(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    cases = [case for case in CASES if "encoding" not in case]
    tags, expected, address = [], {}, 0
    for number, case in enumerate(cases):
        if case["type"].startswith("bit:"):
            continue
        memory.write("holding_registers", address, case["registers"])
        order = case["order"]
        if (case["type"], order) == ("float64", "CDAB"):
            order = "GHEFCDAB"  # The four letters are those of tentacle-modbus.
        tags.append(tag(f"t{number}", address, case["type"], byteOrder=order))
        expected[f"t{number}"] = as_json(case["value"], case["type"])
        address += len(case["registers"])
    assert len(tags) > 80
    data = caller.listen("modbus.data.plc1")
    answer = caller.request("modbus.subscribe", subscription(server, *tags))
    assert answer == {"success": True, "count": len(tags)}
    found = first_values(data, len(tags))
    assert {id: message["value"] for id, message in found.items()} == expected


def test_bits_of_registers_and_of_bit_areas(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0b1000, 7])
    memory.write("coils", 5, [1, 0, 1])
    memory.write("discrete_inputs", 999, [1])
    data = caller.listen("modbus.data.plc1")
    tags = [
        tag("bit3", 0, "bit:3"),
        tag("bit2", 0, "bit:2"),
        tag("word", 1, "boolean"),
        tag("zero", 2, "bool"),
        tag("coil", 5, "boolean", functionCode="coil", byteOrder="DCBA"),
        tag("coils", 5, "boolean[3]", functionCode="coil"),
        tag("input", 999, "boolean", functionCode="discrete"),
    ]
    caller.request("modbus.subscribe", subscription(server, *tags, byteOrder="CDAB"))
    found = first_values(data, len(tags))
    assert {id: message["value"] for id, message in found.items()} == {
        "bit3": True,
        "bit2": False,
        "word": True,
        "zero": False,
        "coil": True,
        "coils": [True, False, True],
        "input": True,
    }
    assert {id: message["datatype"] for id, message in found.items()} == {
        **dict.fromkeys(("bit3", "bit2", "word", "zero", "coil", "input"), "boolean"),
        "coils": "array",
    }


def test_texts_are_json_whatever_is_in_them(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    id = 'a "tag", 100 %d\\ with ümlauts'
    memory.write("holding_registers", 0, [0x2522, 0x2C5C])
    data = caller.listen("modbus.data.größe%s")
    request = subscription(server, tag(id, 0, "string:4"), deviceId="größe%s")
    assert caller.request("modbus.subscribe", request)["success"]
    message = data.next()
    assert message["variableId"] == id
    assert message["deviceId"] == "größe%s"
    assert (message["value"], message["datatype"]) == ('%",\\', "string")


def test_what_can_not_be_decoded_costs_only_its_own_tag(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0x00FA, 5, 0xFFFF])
    tags = [tag("bcd", 0, "bcd16"), tag("good", 1), tag("text", 2, "string:2")]
    data = caller.listen("modbus.data.plc1")
    caller.request("modbus.subscribe", subscription(server, *tags))
    values = {id: message["value"] for id, message in first_values(data, 3).items()}
    assert values == {"bcd": None, "good": 5, "text": None}
    [device] = caller.request("modbus.browse", b"")["devices"]
    errors = {each["id"]: each.get("error") for each in device["tags"]}
    assert errors["good"] is None
    assert "bcd16" in errors["bcd"]
    assert errors["text"]

    memory.write("holding_registers", 0, [0x0012])
    data.until(lambda message: message["value"] == 12, "the value that is right now")


def test_what_can_not_be_decoded_is_a_change_to_null_and_back(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    data = caller.listen("modbus.data.plc1")
    caller.request("modbus.subscribe", subscription(server, tag("a", 0, "bcd16"), publish="change"))
    assert data.next()["value"] == 0
    for registers, value in (([0x1A2B], None), ([0x0042], 42), ([0xFFFF], None)):
        memory.write("holding_registers", 0, registers)
        assert data.next()["value"] == value
    memory.write("holding_registers", 0, [0xAAAA])
    _seen(caller, server)
    assert data.take() == []


def test_texts_have_the_encoding_that_is_said(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0x35B0, 0x4300, 0xC3BC, 0x2121])
    tags = [
        tag("latin", 0, "string:4", encoding="latin-1", writable=True),
        tag("utf", 2, "string:4", encoding="utf-8"),
        tag("ascii", 2, "string:4"),
        tag("marked", 2, "string:4", encoding="utf-8", null=["ü!!"]),
    ]
    data = caller.listen("modbus.data.plc1")
    answer = caller.request("modbus.subscribe", subscription(server, *tags))
    assert answer["success"], answer
    found = {id: message["value"] for id, message in first_values(data, 4).items()}
    assert found == {"latin": "5°C", "utf": "ü!!", "ascii": None, "marked": None}
    assert caller.request("modbus.command.latin", "ßä")["success"]
    assert memory.read("holding_registers", 0, 2) == [0xDFE4, 0]
    assert "latin-1" in caller.request("modbus.command.latin", "€")["error"]
    [device] = caller.request("modbus.browse", b"")["devices"]
    assert [each.get("encoding") for each in device["tags"]] == ["latin-1", "utf-8", None, "utf-8"]


def test_an_array_changes_when_one_of_its_values_does(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [100, 200, 0])
    data = caller.listen("modbus.data.plc1")
    request = subscription(server, tag("a", 0, "uint16[3]"), publish="change", deadband=5)
    caller.request("modbus.subscribe", request)
    assert data.next()["value"] == [100, 200, 0]
    for values in ([105, 195, 5], [105, 195, 6], [100, 200, 1], [105, 206, 1]):
        memory.write("holding_registers", 0, values)
        _seen(caller, server)
    assert [message["value"] for message in data.take()] == [[105, 195, 6], [105, 206, 1]]


def test_values_that_mean_not_available_are_null(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    nan, sentinel = [0x7FC0, 0], [0xC61C, 0x3C00]
    memory.write("holding_registers", 0, [0x8000, 0xFFFF, *nan, *sentinel, 1, 0xFFFF, *nan])
    tags = [
        tag("int16", 0, "int16", null=[-32768]),
        tag("uint16", 1, null=[65535, 65534]),
        tag("nan", 2, "float32", null=["nan"]),
        tag("float", 4, "float32", null=[-9999, 1.1]),
        tag("array", 6, "uint16[2]", null=[65535]),
        tag("unmarked", 8, "float32"),
        tag("good", 6, "uint16", null=[2]),
    ]
    data = caller.listen("modbus.data.plc1")
    answer = caller.request("modbus.subscribe", subscription(server, *tags))
    assert answer["success"], answer
    found = {id: message["value"] for id, message in first_values(data, len(tags)).items()}
    assert found == {
        **dict.fromkeys(("int16", "uint16", "nan", "float", "unmarked")),
        "array": [1, None],
        "good": 1,
    }
    memory.write("holding_registers", 0, [5])
    data.until(lambda message: message["value"] == 5, "the value is back")


def test_a_change_is_published_once(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    data = caller.listen("modbus.data.plc1")
    beat = tag("beat", 9)
    tags = [tag("a", 0), tag("b", 1, "boolean"), tag("s", 2, "string:2"), tag("f", 4, "float32")]
    caller.request("modbus.subscribe", subscription(server, *tags, publish="change"))
    assert sorted(data.next()["variableId"] for _ in range(4)) == ["a", "b", "f", "s"]

    other = subscription(server, beat, subscriberId="other")
    caller.request("modbus.subscribe", other)
    changes: list[tuple[str, Any]] = []

    def scans(count: int) -> None:
        """Takes the messages of some whole scans."""
        while count:
            message = data.next()
            if message["variableId"] == "beat":
                count -= 1
            else:
                changes.append((message["variableId"], message["value"]))

    scans(3)
    assert changes == []
    memory.write("holding_registers", 0, [7, 1, 0x4142])
    scans(4)
    assert changes == [("a", 7), ("b", True), ("s", "AB")]
    memory.write("holding_registers", 4, [0x7FC0, 0])
    scans(4)
    assert changes[3:] == [("f", None)]

    again = subscription(server, *tags[:1], publish="change", subscriberId="third")
    caller.request("modbus.subscribe", again)
    scans(3)
    assert changes[4:] == [("a", 7)]


def test_a_number_within_its_deadband_has_not_changed(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    data = caller.listen("modbus.data.plc1")
    memory.write("holding_registers", 0, [100])
    wide = subscription(server, tag("a", 0), publish="change", deadband=5)
    caller.request("modbus.subscribe", wide)
    assert data.next()["value"] == 100
    for value in (101, 105, 95, 106, 110, 101, 100):
        memory.write("holding_registers", 0, [value])
        _seen(caller, server)
    assert [message["value"] for message in data.take()] == [106, 100]

    narrow = subscription(server, tag("a", 0), publish="change", subscriberId="narrow")
    caller.request("modbus.subscribe", narrow)
    assert data.next()["value"] == 100
    memory.write("holding_registers", 0, [101])
    assert data.next()["value"] == 101


def _seen(caller: Caller, server: holdfast.Server) -> None:
    """Waits until the device was scanned twice, so that what it has now was seen."""

    def scans() -> int:
        [device] = caller.request("modbus.browse", b"")["devices"]
        return int(device["scans"])

    del server
    enough = scans() + 2
    wire.until(lambda: scans() >= enough, "two more scans")


def test_infinities_and_large_numbers_are_json(
    caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0x7F80, 0, 0xFF80, 0, *[0xFFFF] * 4, 0x7F7F, 0xFFFF])
    tags = [
        tag("inf", 0, "float32"),
        tag("-inf", 2, "float32"),
        tag("large", 4, "uint64"),
        tag("max", 8, "float32"),
    ]
    data = caller.listen("modbus.data.plc1")
    for publish in ("scan", "change"):
        request = subscription(server, *tags, publish=publish, subscriberId=publish)
        caller.request("modbus.subscribe", request)
        found = {id: message["value"] for id, message in first_values(data, 4).items()}
        assert found == {
            "inf": None,
            "-inf": None,
            "large": 2**64 - 1,
            "max": (2 - 2**-23) * math.ldexp(1, 127),
        }
        data.take()
