"""Sparkplug outputs and Tahu's library for JavaScript, with which Node-RED reads and writes."""

from __future__ import annotations

from typing import Any

import pytest

from holdfast.outputs.sparkplug.datatypes import datatype_of, value_of
from holdfast.outputs.sparkplug.definition import parsed
from holdfast.outputs.sparkplug.node import EdgeNode, Names
from holdfast.polling import Reading
from holdfast.tags import Tag
from support.peer_programs import node

CASES: list[tuple[Tag, Any, str, Any]] = [
    (Tag("int16", "holding_registers", 0, "int16"), -30000, "Int16", -30000),
    (Tag("uint16", "holding_registers", 0), 52360, "UInt16", 52360),
    (Tag("int32", "holding_registers", 0, "int32"), -2, "Int32", -2),
    (Tag("uint32", "holding_registers", 0, "uint32"), 3293969225, "UInt32", 3293969225),
    (Tag("zero", "holding_registers", 0, "uint32"), 0, "UInt32", 0),
    (Tag("bcd32", "holding_registers", 0, "bcd32"), 99999999, "UInt32", 99999999),
    (Tag("int64", "holding_registers", 0, "int64"), -3, "Int64", "-3"),
    (Tag("uint64", "holding_registers", 0, "uint64"), 2**64 - 1, "UInt64", str(2**64 - 1)),
    (Tag("float32", "holding_registers", 0, "float32"), 21.5, "Float", 21.5),
    (Tag("float64", "holding_registers", 0, "float64"), 0.1, "Double", 0.1),
    (Tag("scaled", "holding_registers", 0, "uint32", scale=0.1), 0.3, "Double", 0.3),
    (Tag("text", "holding_registers", 0, "string:6"), "ABC", "String", "ABC"),
    (Tag("bytes", "holding_registers", 0, "bytes:2"), b"\x0a\xff", "Bytes", "0aff"),
    (Tag("bit", "holding_registers", 0, "bit:3"), True, "Boolean", True),
    (Tag("none", "holding_registers", 0, "uint32"), None, "UInt32", None),
]
TAGS = [tag for tag, *_ in CASES]


def messages(*, always_typed: bool) -> list[dict[str, Any]]:
    """A birth without values, and their data."""
    made = EdgeNode(Names("group", "edge"), int, always_typed=always_typed)
    made.begin()
    made.adopt({"pump": TAGS})
    *_, birth = made.births({"pump": True}, dict)
    readings = [Reading("pump", tag, value, 2.0**33, 0) for tag, value, *_ in CASES]
    [data] = made.data(readings, dict, 0)
    return [{"call": "decode", "payload": each.payload.hex()} for each in (birth, data)]


def test_a_birth_and_typed_data_are_decoded() -> None:
    birth, data = node("sparkplug-payload").results("", 0, messages(always_typed=True))
    assert [(each["name"], each["type"]) for each in birth["value"]] == [
        (tag.name, type) for tag, _, type, _ in CASES
    ]
    assert [(each["type"], each["value"]) for each in data["value"]] == [
        (type, value) for *_, type, value in CASES
    ]


def test_a_birth_with_values_is_decoded() -> None:
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": TAGS})
    latest = {"pump": {tag.name: Reading("pump", tag, value, 1.0, 0) for tag, value, *_ in CASES}}
    *_, birth = made.births({"pump": True}, lambda: latest)
    [found] = node("sparkplug-payload").results(
        "", 0, [{"call": "decode", "payload": birth.payload.hex()}]
    )
    assert [(each["name"], each["type"], each["value"]) for each in found["value"]] == [
        (tag.name, type, value) for tag, _, type, value in CASES
    ]


def test_data_without_types_has_none_for_a_reader_without_the_birth() -> None:
    _, data = node("sparkplug-payload").results("", 0, messages(always_typed=False))
    assert [each["value"] for each in data["value"]] == [None] * len(CASES)


@pytest.mark.parametrize(
    ("type", "kind", "value"),
    [("uint32", "UInt32", 3293969225), ("int16", "Int16", 5), ("float32", "Float", 21.5)],
)
def test_its_commands_have_values(type: str, kind: str, value: float) -> None:
    metric = {"name": "x", "type": kind, "value": value}
    [sent] = node("sparkplug-payload").results("", 0, [{"call": "encode", "metrics": [metric]}])
    [found] = parsed(bytes.fromhex(sent["value"])).metrics
    datatype, _ = datatype_of(Tag("x", "holding_registers", 0, type))
    assert value_of(found, datatype) == value
