"""A published metric that is sent back as a command writes what the registers had."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st

from holdfast.appliance.parts.tag_writes import _request
from holdfast.net.mqtt.packets import Publish
from holdfast.outputs.device_access import NotWritten
from holdfast.outputs.sparkplug.commands import Commands
from holdfast.outputs.sparkplug.definition import Metric, Payload, parsed
from holdfast.outputs.sparkplug.node import EdgeNode, Names
from holdfast.polling import Reading
from holdfast.tags import Tag
from holdfast.values import ConversionError, codec_for, decode
from support.cases import examples

if TYPE_CHECKING:
    from collections.abc import Callable


class Site:
    """A site that encodes what is written, as that of the appliance does."""

    def __init__(self, tag: Tag) -> None:
        self._tag = tag
        self.written: list[list[int]] = []

    def write(
        self,
        device: str,
        tag: str,
        text: str,
        peer: str,
        done: Callable[[NotWritten | None], None],
        *,
        states: bool = True,
    ) -> None:
        assert (device, tag, peer) == ("pump", self._tag.name, "broker topic")
        _, values = _request(self._tag, text, states=states)
        self.written.append(values)
        done(None)


def born(tag: Tag, value: Any) -> tuple[EdgeNode, Any, Any]:
    """A node with the metric of a value: in a birth, and in data without name and type."""
    node = EdgeNode(Names("group", "edge"), int)
    node.begin()
    node.adopt({"pump": [tag]})
    first = {"pump": {tag.name: Reading("pump", tag, value, 1.0, 0)}}
    *_, birth = node.births({"pump": True}, lambda: first)
    [data] = node.data([Reading("pump", tag, value, 2.0, 0)], dict, 0)
    [known], [later] = (parsed(message.payload).metrics for message in (birth, data))
    return node, known, later


def sent(node: EdgeNode, tag: Tag, metric: Any) -> tuple[list[list[int]], Commands]:
    """What a command with a metric writes to the registers."""
    site = Site(tag)
    commands = Commands("scada", "broker", site, node.find, writes=True)  # type: ignore[arg-type]
    data = Payload(metrics=[metric]).SerializeToString()
    message = Publish("topic", 0, 0, memoryview(data), len(data))
    commands.take(message, "pump")
    return site.written, commands


def tag(type: str, area: Any = "holding_registers", **more: Any) -> Tag:
    return Tag("x", area, 3, type, writable=True, **more)


FLOATS = ("float16", "float32", "float64")
TAGS = [
    *(tag(type) for type in ("int16", "int32", "int64", "uint16", "uint32", "uint64")),
    *(tag(type) for type in ("bcd16", "bcd32", "bit:0", "bit:15", "string:6", "bytes:4")),
    *(tag(type) for type in FLOATS),
    *(tag(f"{type}[3]") for type in ("int16", "int32", "int64", "uint16", "uint32", "uint64")),
    *(tag(f"{type}[2]") for type in (*FLOATS, "bcd16", "bcd32", "string:4")),
    *(tag(type, scale=scale) for type in ("int16", "uint32", "bcd16") for scale in (0.1, 10, -1)),
    *(tag(type, scale=0.01, offset=-40) for type in ("int16", "int32", "uint16[3]")),
    # A `float64` with a scale has more digits than the metric.
    *(tag(type, scale=0.1) for type in ("float16", "float32", "float32[2]")),
    tag("bool", "coils"),
    tag("bool[11]", "coils"),
    tag("int16", null=frozenset({-0x8000})),
    tag("uint16", states={0: "1", 1: "2", 2: "3", 7: "0"}),
    tag("int16", states={-1: "-2", -2: "-1", 5: "05", 6: "5"}),
    tag("uint16", scale=0.5, states={0: "0.5", 1: "0.0"}),
    tag("bit:2", states={0: "true", 1: "false"}),
    tag("bool", "coils", states={0: "true", 1: "false"}),
    tag("bool[2]", "coils", states={0: "[true,true]", 1: "[false,false]"}),
]


@pytest.mark.parametrize("tag", TAGS, ids=lambda tag: f"{tag.type} {tag.scale} {tag.states}")
@settings(max_examples=examples(20))
@given(data=st.data())
def test_what_is_published_can_be_sent_back(tag: Tag, data: st.DataObject) -> None:
    one: st.SearchStrategy[int] = st.integers(0, 4) | st.integers(0, 0xFFFF)
    if tag.of_bits:
        one = st.booleans()
    elif tag.of_type.base == "string":
        one = st.sampled_from([0x4142, 0x2061, 0x7A00, 0x0000])
    contents = data.draw(st.lists(one, min_size=tag.count, max_size=tag.count))
    try:
        raw: Any = decode(contents, tag.type, tag.order)
    except ConversionError:
        reject()
    items = raw if isinstance(raw, list) else [raw]
    # No value, and infinity, which no command can write.
    assume(not any(isinstance(item, float) and not math.isfinite(item) for item in items))
    assume(not any(tag.is_null(item) for item in items))
    # In an array, NUL ends each text.
    assume(not isinstance(raw, list) or not any("\0" in str(item) for item in items))
    codec = codec_for(tag.area, tag.type, tag.order, tag.encoding)
    expected = [raw] if tag.of_type.base == "bit" else codec.encode(raw)

    node, birth, later = born(tag, tag.value(raw))
    for metric in (birth, later):
        written, commands = sent(node, tag, metric)
        assert (written, commands.refused, commands.ignored) == ([expected], 0, 0)


@pytest.mark.parametrize("type", ["float32", "float32[1]"])
@pytest.mark.parametrize(
    ("limit", "registers"), [({"min": 0.7}, [0x3F33, 0x3333]), ({"max": 0.1}, [0x3DCC, 0xCCCD])]
)
def test_a_float_at_its_limit_is_within_it(
    type: str, limit: dict[str, float], registers: list[int]
) -> None:
    of = tag(type, **limit)
    node, _, later = born(of, decode(registers, type))
    written, _ = sent(node, of, later)
    assert written == [registers]


@pytest.mark.parametrize(
    ("tag", "fields", "written"),
    [
        (tag("uint16", states={0: "1", 1: "2", 2: "3"}), {"int_value": 1}, 1),
        (tag("uint16", states={0: "1", 1: "2", 2: "3"}), {"int_value": 3}, 3),
        (tag("int16", states={0: "-1"}), {"int_value": 0xFFFF}, 0xFFFF),
        (tag("uint16", scale=0.5, states={0: "1.0"}), {"double_value": 1.0}, 2),
        (tag("uint16", scale=0.5, states={0: "1"}), {"datatype": 3, "int_value": 1}, 2),
        (tag("bit:2", states={0: "true", 1: "false"}), {"boolean_value": True}, 1),
        (tag("bool", "coils", states={0: "true", 1: "false"}), {"boolean_value": True}, 1),
        (tag("bool", "coils", states={0: "true", 1: "false"}), {"boolean_value": False}, 0),
        (tag("bool", "coils", states={0: "on", 1: "true"}), {"boolean_value": True}, 1),
    ],
    ids=lambda case: "" if isinstance(case, Tag) else str(case),
)
def test_a_number_is_never_the_name_of_a_state(
    tag: Tag, fields: dict[str, Any], written: int
) -> None:
    node, birth, _ = born(tag, 0)
    found, _ = sent(node, tag, Metric(alias=birth.alias, **fields))
    assert found == [[written]]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_no_state(value: float) -> None:
    of = tag("uint16", scale=0.5, states={0: "nan", 1: "inf", 2: "-inf"})
    node, birth, _ = born(of, 0)
    written, commands = sent(node, of, Metric(alias=birth.alias, double_value=value))
    assert (written, commands.refused) == ([], 1)
