"""Parts of Sparkplug outputs: types, sequence numbers, and the order of messages."""

from __future__ import annotations

import contextlib
import math
import struct
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.config.models.outputs import SparkplugConfig
from holdfast.outputs import Buffer, Refused
from holdfast.outputs.sparkplug.datatypes import datatype_of, value_of
from holdfast.outputs.sparkplug.definition import Metric, parsed
from holdfast.outputs.sparkplug.node import EdgeNode, Names
from holdfast.outputs.sparkplug.output import SparkplugOutput
from holdfast.outputs.sparkplug.primary_host import PrimaryHost
from holdfast.polling import Reading
from holdfast.polling.faults import FAULTS
from holdfast.tags import Tag
from holdfast.tags.scale import RegisterScale

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.outputs.mqtt.delivery import Message

SPEED = Tag("speed", "input_registers", 0)
LEVEL = Tag("level", "input_registers", 1)


def reading(
    value: Any, time: float, tag: Tag = SPEED, device: str = "pump", fault: int = 0
) -> Reading:
    return Reading(device, tag, value, time, fault)


def latest(*readings: Reading) -> dict[str, dict[str, Reading]]:
    found: dict[str, dict[str, Reading]] = {}
    for each in readings:
        found.setdefault(each.device, {})[each.tag.name] = each
    return found


def node(*readings: Reading, waiting: int = 0) -> EdgeNode:
    """A node in a session, with a device of these current values, and so many that wait."""
    made = EdgeNode(Names("group", "edge"), lambda: waiting)
    made.begin()
    made.adopt({"pump": [SPEED, LEVEL]})
    list(made.births({"pump": True}, lambda: latest(*readings)))
    return made


def kinds(messages: Iterable[Message]) -> list[str]:
    return [message.topic[2:].decode().split("/")[2] for message in messages]


def payload(message: Message) -> Any:
    return parsed(message.payload)


@pytest.mark.parametrize(
    ("type", "values", "number", "data"),
    [  # The examples of the specification, except for floats, which it shows in another order.
        ("int16[2]", [-30000, 30000], 23, "D08A3075"),
        ("int32[2]", [-1, 315338746], 24, "FFFFFFFFFAAFCB12"),
        (
            "int64[2]",
            [-4270929666821191986, -3601064768563266876],
            25,
            "CE0672AC189CBAC4C4BA9C18AC7206CE",
        ),
        ("uint16[2]", [30, 52360], 27, "1E0088CC"),
        ("uint32[2]", [52, 3293969225], 28, "3400000049FB55C4"),
        ("uint64[2]", [52, 16444743074749521625], 29, "3400000000000000D99E02D1B27637E4"),
        ("float32[2]", [1.5, None], 30, "0000C03F0000C07F"),
        ("float64[1]", [1.5], 31, "000000000000F83F"),
        ("string:6[2]", ["ABC", "hello"], 33, "4142430068656C6C6F00"),
    ],
)
def test_arrays_are_those_of_the_specification(
    type: str, values: list[Any], number: int, data: str
) -> None:
    datatype, by_item = datatype_of(Tag("x", "holding_registers", 0, type))
    assert (datatype.number, by_item) == (number, False)
    packed = datatype.packed(values)
    assert packed.hex().upper() == data
    if None not in values:
        assert value_of(Metric(bytes_value=packed), datatype) == values


def test_a_text_of_an_array_has_no_nul_inside() -> None:
    single, _ = datatype_of(Tag("x", "holding_registers", 0, "string:4"))
    array, _ = datatype_of(Tag("x", "holding_registers", 0, "string:4[2]"))
    assert single.packed("a\0b") == "a\0b"
    assert array.packed(["a\0b", "cd"]) == b"ab\0cd\0"


def test_an_integer_that_is_too_large_for_a_double_is_infinite() -> None:
    tag = Tag("x", "holding_registers", 0, "uint16[2]", scale=1e308)
    datatype, _ = datatype_of(tag)
    assert datatype.packed(tag.value([65535, 0])) == struct.pack("<2d", math.inf, 0)


def test_a_scale_in_a_register_makes_any_number_a_double() -> None:
    scale = RegisterScale("exponent", source=Tag("", "holding_registers", 1, "int16"))
    datatype, _ = datatype_of(Tag("x", "holding_registers", 0, "uint16", scale=scale))
    assert (datatype.name, datatype.packed(4320)) == ("Double", 4320.0)


def test_a_scaled_float_has_its_digits_in_a_double() -> None:
    tag = Tag("x", "holding_registers", 0, "float32", scale=10)
    datatype, _ = datatype_of(tag)
    assert datatype.packed(tag.value(230.10000610351562)) == 2301
    assert datatype.packed(tag.value(math.inf)) == math.inf
    many, _ = datatype_of(replace(tag, type="float32[2]"))
    assert value_of(Metric(bytes_value=many.packed([2301.0000610351562, None])), many)[0] == 2301


TAGS = [
    Tag("x", "holding_registers", 0, type)
    for type in ("int16", "uint64", "float32", "float64[2]", "string:4", "string:4[2]", "bytes:4")
]


@given(
    fields=st.fixed_dictionaries(
        {},
        optional={
            "datatype": st.integers(0, 40),
            "is_null": st.booleans(),
            "int_value": st.integers(0, 2**32 - 1),
            "long_value": st.integers(0, 2**64 - 1),
            "float_value": st.floats(width=32),
            "double_value": st.floats(),
            "boolean_value": st.booleans(),
            "string_value": st.text(st.characters(exclude_categories=["Cs"])),
            "bytes_value": st.binary(max_size=40),
        },
    ),
    tag=st.sampled_from([*TAGS, Tag("x", "coils", 0, "bool[3]"), Tag("x", "coils", 0)]),
)
def test_any_metric_has_a_value_or_an_error(fields: dict[str, Any], tag: Tag) -> None:
    with contextlib.suppress(ValueError):
        value_of(Metric(**fields), datatype_of(tag)[0])


@pytest.mark.parametrize(
    ("type", "fields", "value"),
    [
        # Tahu's client for Python sends the bits of the type, its others those of the field.
        ("int16", {"datatype": 2, "int_value": 0xFFFB}, -5),
        ("int16", {"datatype": 2, "int_value": 0xFFFFFFFB}, -5),
        ("int16", {"datatype": 2, "long_value": 0xFFFB}, -5),
        ("int16", {"datatype": 2, "long_value": 0xFFFFFFFFFFFFFFFB}, -5),
        ("int16", {"datatype": 2, "int_value": 0x8000}, -0x8000),
        ("int16", {"datatype": 2, "int_value": 0x7FFF}, 0x7FFF),
        ("int16", {"datatype": 2, "int_value": 0x8000_0000}, None),
        ("int16", {"datatype": 2, "int_value": 0xFFFF7FFF}, None),
        ("int16", {"datatype": 2, "int_value": 0x10000}, None),
        ("int16", {"datatype": 2, "long_value": 0xFFFFFFFB}, None),
        ("int16", {"datatype": 1, "int_value": 251}, -5),
        ("int16", {"datatype": 1, "int_value": 0xFFFFFFFB}, -5),
        ("int16", {"datatype": 1, "int_value": 127}, 127),
        ("int16", {"datatype": 1, "int_value": 256}, None),
        ("int16", {"datatype": 1, "int_value": 0xFFFB}, None),
        ("int32", {"datatype": 2, "int_value": 65531}, -5),
        ("int32", {"datatype": 3, "int_value": 0xFFFFFFFB}, -5),
        ("int32", {"datatype": 3, "long_value": 0xFFFFFFFB}, -5),
        ("int32", {"datatype": 3, "long_value": 0xFFFFFFFFFFFFFFFB}, -5),
        ("int32", {"datatype": 3, "int_value": 65531}, 65531),
        ("int32", {"datatype": 3, "long_value": 2**32}, None),
        ("int64", {"datatype": 4, "long_value": 0xFFFFFFFFFFFFFFFB}, -5),
        ("int64", {"datatype": 4, "long_value": 0xFFFFFFFB}, 0xFFFFFFFB),
        ("int64", {"datatype": 4, "int_value": 0x7FFFFFFF}, 0x7FFFFFFF),
        # It may be negative, or not.
        ("int64", {"datatype": 4, "int_value": 0xFFFFFFFB}, None),
        ("uint16", {"datatype": 5, "int_value": 251}, 251),
        ("uint16", {"datatype": 5, "int_value": 256}, None),
        ("int32", {"datatype": 6, "int_value": 65531}, 65531),
        ("int32", {"datatype": 6, "int_value": 0xFFFFFFFB}, None),
        ("uint32", {"datatype": 7, "int_value": 0xFFFFFFFB}, 0xFFFFFFFB),
        ("uint32", {"datatype": 7, "long_value": 2**32}, None),
        ("uint64", {"datatype": 8, "long_value": 2**64 - 1}, 2**64 - 1),
        # Without a type, that of the birth counts.
        ("int16", {"int_value": 0xFFFB}, -5),
        ("int16", {"int_value": 0xFFFFFFFB}, -5),
        ("int64", {"long_value": 0xFFFFFFFFFFFFFFFB}, -5),
        ("uint16", {"int_value": 0xFFFB}, 0xFFFB),
        ("uint16", {"int_value": 0xFFFFFFFB}, None),
        ("uint32", {"int_value": 0xFFFFFFFB}, 0xFFFFFFFB),
        ("float32", {"datatype": 2, "int_value": 65531}, -5),
        ("float64", {"datatype": 1, "int_value": 251}, -5),
        ("float64", {"datatype": 7, "long_value": 0xFFFFFFFB}, 0xFFFFFFFB),
        # No integer is a Float, and no other type is one of integers.
        ("float32", {"int_value": 65531}, None),
        ("float32", {"datatype": 9, "int_value": 1}, None),
        ("float64", {"long_value": 1}, None),
        ("float64", {"datatype": 10, "long_value": 1}, None),
        ("uint16", {"datatype": 10, "int_value": 1}, None),
        ("uint16", {"datatype": 11, "int_value": 1}, None),
        ("uint64", {"datatype": 13, "long_value": 1}, None),
    ],
    ids=str,
)
def test_an_integer_has_the_sign_of_its_type(
    type: str, fields: dict[str, int], value: int | None
) -> None:
    datatype, _ = datatype_of(Tag("x", "holding_registers", 0, type))
    metric = Metric(**fields)
    if value is None:
        with pytest.raises(ValueError, match=r"is no U?Int|a type of integers"):
            value_of(metric, datatype)
    else:
        assert value_of(metric, datatype) == value


@pytest.mark.parametrize(
    ("type", "number", "data"),
    [
        ("int16[4]", 24, "FBFFFFFF07000000"),
        ("int16[2]", 27, "FBFF0700"),
        ("bytes:4", 23, "61626364"),
    ],
)
def test_an_array_of_another_type_is_an_error(type: str, number: int, data: str) -> None:
    datatype, _ = datatype_of(Tag("x", "holding_registers", 0, type))
    metric = Metric(datatype=number, bytes_value=bytes.fromhex(data))
    with pytest.raises(ValueError, match=f"found the type {number}, allowed: {datatype.name}"):
        value_of(metric, datatype)


def test_an_array_has_no_more_numbers_than_a_tag() -> None:
    datatype, _ = datatype_of(Tag("x", "holding_registers", 0, "float32[2]"))
    assert len(value_of(Metric(bytes_value=bytes(4 * 2000)), datatype)) == 2000
    with pytest.raises(ValueError, match="another length"):
        value_of(Metric(bytes_value=bytes(4 * 2001)), datatype)


def test_bits_begin_with_the_most_significant_one() -> None:
    values = [False, False, True, True, False, True, False, False, True, True, False, True]
    datatype, _ = datatype_of(Tag("x", "coils", 0, "bool[12]"))
    packed = datatype.packed(values)
    assert packed == bytes([12, 0, 0, 0, 0x34, 0xD0])
    assert value_of(Metric(bytes_value=packed), datatype) == values


@pytest.mark.parametrize(
    ("tag", "expected"),
    [
        (Tag("x", "holding_registers", 0, "bcd16"), "UInt16"),
        (Tag("x", "holding_registers", 0, "bcd32"), "UInt32"),
        (Tag("x", "holding_registers", 0, "float16"), "Float"),
        (Tag("x", "holding_registers", 0, "int16", scale=10), "Double"),
        (Tag("x", "holding_registers", 0, "float32", offset=1), "Double"),
        (Tag("x", "holding_registers", 0, "uint16[2]", scale=0.1), "DoubleArray"),
        (Tag("x", "holding_registers", 0, "bytes:4"), "Bytes"),
        (Tag("x", "holding_registers", 0, "bytes:4[2]"), "Bytes by item"),
        (Tag("x", "holding_registers", 0, "int16[2]", null=frozenset({-1})), "Int16 by item"),
        (
            Tag("x", "holding_registers", 0, "int16[2]", scale=0.1, null=frozenset({-1})),
            "DoubleArray",
        ),
    ],
)
def test_types_of_metrics(tag: Tag, expected: str) -> None:
    datatype, by_item = datatype_of(tag)
    assert f"{datatype.name}{' by item' if by_item else ''}" == expected


@pytest.mark.parametrize(
    ("type", "field"),
    [
        ("uint16", "int_value"),
        ("int32", "int_value"),
        ("uint32", "long_value"),
        ("bcd32", "long_value"),
        ("uint64", "long_value"),
    ],
)
def test_unsigned_integers_of_32_bits_are_long(type: str, field: str) -> None:
    tag = Tag("speed", "input_registers", 0, type)
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": [tag]})
    *_, birth = made.births({"pump": True}, lambda: latest(reading(7, 1.0, tag)))
    [data] = made.data([reading(8, 2.0, tag)], latest, 0)
    for message, value in ((birth, 7), (data, 8)):
        [metric] = payload(message).metrics
        assert metric.HasField(field)
        assert getattr(metric, field) == value


@pytest.mark.parametrize("always_typed", [False, True])
def test_data_has_types_if_they_are_always_wanted(always_typed: bool) -> None:
    made = EdgeNode(Names("group", "edge"), int, always_typed=always_typed)
    made.begin()
    made.adopt({"pump": [SPEED]})
    *_, birth = made.births({"pump": True}, lambda: latest(reading(0, 10.0)))
    found = [payload(birth).metrics[0]]
    for some in (reading(3, 8.0), reading(5, 11.0), reading(None, 12.0, fault=2)):
        [message] = made.data([some], latest, 0)
        found += payload(message).metrics
    assert [metric.HasField("datatype") for metric in found] == [True, *[always_typed] * 3]
    assert {metric.datatype for metric in found} <= {0, 6}


@pytest.mark.parametrize(
    ("area", "type", "number", "field", "value"),
    [
        ("holding_registers", "int16", 2, "int_value", 7),
        ("holding_registers", "int32", 3, "int_value", 7),
        ("holding_registers", "int64", 4, "long_value", 7),
        ("holding_registers", "uint16", 6, "int_value", 7),
        ("holding_registers", "uint32", 7, "long_value", 7),
        ("holding_registers", "uint64", 8, "long_value", 7),
        ("holding_registers", "float32", 9, "float_value", 1.5),
        ("holding_registers", "float64", 10, "double_value", 1.5),
        ("coils", "bool", 11, "boolean_value", True),
        ("holding_registers", "string:4", 12, "string_value", "ab"),
        ("holding_registers", "bytes:4", 17, "bytes_value", b"ab"),
    ],
)
def test_a_birth_has_type_and_value_of_each_metric(
    area: Any, type: str, number: int, field: str, value: Any
) -> None:
    tag = Tag("speed", area, 0, type)
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": [tag]})
    *_, birth = made.births({"pump": True}, lambda: latest(reading(value, 1.0, tag)))
    [metric] = payload(birth).metrics
    assert (metric.name, metric.datatype, metric.is_null) == ("speed", number, False)
    assert (metric.HasField(field), getattr(metric, field)) == (True, value)


def test_messages_have_the_time_now_and_metrics_the_time_of_their_reading(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(time, "time", lambda: 1_700_000_000.25)
    now = 1_700_000_000_250
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": [SPEED, LEVEL]})
    births = list(made.births({"pump": True}, lambda: latest(reading(5, 10.5))))
    data = list(made.data([reading(3, 8.25), reading(6, 11.75)], latest, 0))
    messages = [*births, *data, *made.device_deaths({"pump": False}), made.death()]

    times = [
        (payload(message).timestamp, [metric.timestamp for metric in payload(message).metrics])
        for message in messages
    ]
    assert kinds(messages) == ["NBIRTH", "DBIRTH", "DDATA", "DDATA", "DDEATH", "NDEATH"]
    assert times == [
        (now, [now, now]),
        # There is no reading of the second tag yet.
        (now, [10_500, now]),
        (now, [8_250]),
        (now, [11_750]),
        (now, []),
        (now, [now]),
    ]


def test_all_messages_but_the_death_of_the_node_are_numbered_from_its_birth() -> None:
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": [SPEED], "fan": [SPEED]})
    births = made.births({"pump": True, "fan": True}, latest)
    data = list(made.data([reading(3, 8.0)], latest, 0))
    deaths = made.device_deaths({"pump": False, "fan": True})

    assert [payload(each).seq for each in [*births, *data, *deaths]] == [0, 1, 2, 3, 4]
    assert not payload(made.death()).HasField("seq")
    assert [payload(each).seq for each in made.births({"fan": True}, latest)] == [0, 1]


def test_sequence_numbers_begin_again_after_255() -> None:
    made = node(reading(0, 1.0))
    found = [
        payload(message).seq
        for time in range(300)
        for message in made.data([reading(time, 2.0 + time)], latest, 0)
    ]
    assert found == [number % 256 for number in range(2, 302)]


def test_session_numbers_begin_again_after_255() -> None:
    made = EdgeNode(Names("group", "edge"), int)
    found = []
    for _ in range(258):
        made.begin()
        found.append(payload(made.death()).metrics[0].long_value)
    assert found == [*range(256), 0, 1]


def test_what_a_birth_has_is_not_repeated_and_what_is_older_is_historical() -> None:
    made = node(reading(5, 10.0), reading(7, 10.0, LEVEL), waiting=2)
    some = [reading(3, 8.0), reading(5, 10.0), reading(6, 11.0), reading(8, 11.0, LEVEL)]
    messages = list(made.data(some, latest, 0))
    found = [
        [(metric.int_value, metric.is_historical) for metric in payload(message).metrics]
        for message in messages
    ]
    assert found == [[(3, True)], [(6, False), (8, False)]]


@pytest.mark.parametrize("of", [None, Tag("speed", "input_registers", 0, "string:2")])
def test_after_a_birth_without_value_a_poll_from_before_it_is_current(of: Tag | None) -> None:
    now = time.time()
    # One has waited since before a restart or a reload.
    made = EdgeNode(Names("group", "edge"), lambda: 1)
    made.begin()
    made.adopt({"pump": [SPEED]})
    known = () if of is None else (reading("on", now, of),)
    *_, birth = made.births({"pump": True}, lambda: latest(*known))
    [metric] = payload(birth).metrics
    assert (metric.is_null, metric.timestamp >= int(now * 1000)) == (True, True)
    messages = list(made.data([reading(5, now - 3), reading(6, now - 1)], latest, 0))
    found = [payload(message).metrics[0] for message in messages]
    assert [(metric.int_value, metric.is_historical) for metric in found] == [(5, True), (6, False)]


def test_what_waited_is_historical_whatever_its_time() -> None:
    made = node(reading(5, 10.0), waiting=13)
    some = [reading(3, 20.0), reading(4, 9.0), reading(5, 10.0), reading(6, 11.0)]
    messages = list(made.data(some, latest, 10))
    found = [payload(message).metrics[0] for message in messages]
    assert [(each.int_value, each.is_historical) for each in found] == [
        (3, True),
        (4, True),
        (6, False),
    ]


def test_no_value_is_historical_after_the_clock_was_set_back() -> None:
    made = node(reading(5, time.time() + 3600), reading(7, 10.0, LEVEL))
    [message] = made.data([reading(6, time.time())], latest, 0)
    assert [metric.is_historical for metric in payload(message).metrics] == [False]


def test_a_device_without_birth_is_born_for_its_values_and_dies_after_them() -> None:
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": [SPEED]})
    assert kinds(made.births({"pump": False}, latest)) == ["NBIRTH"]
    silent = reading(None, 10.0, fault=FAULTS["timeout"])
    assert kinds(made.data([silent], latest, 0)) == []
    old = [reading(3, 8.0), silent]
    assert kinds(made.data(old, lambda: latest(silent), 0)) == ["DBIRTH", "DDATA"]
    assert kinds(made.device_deaths({"pump": False}, old)) == []
    assert kinds(made.device_deaths({"pump": False}, [silent])) == ["DDEATH"]


def test_an_exception_is_no_silence() -> None:
    made = node(reading(5, 10.0))
    [message] = made.data([reading(None, 11.0, fault=2)], latest, 0)
    [metric] = payload(message).metrics
    assert metric.is_null
    assert metric.properties.values[0].int_value == 0


def test_a_tag_that_is_no_more_has_no_data() -> None:
    made = node(reading(5, 10.0))
    gone = Tag("gone", "input_registers", 5)
    assert (
        kinds(made.data([reading(5, 11.0, gone), reading(5, 11.0, device="fan")], latest, 0)) == []
    )


FLOW = Tag("flow", "input_registers", 2, "uint16[2]", null=frozenset({65535}))
"""Each item has a metric of its own."""


@pytest.mark.parametrize(
    ("value", "of"),
    [
        (7, Tag("speed", "input_registers", 0, scale=0.1)),
        ("on", Tag("speed", "input_registers", 0, "string:2")),
        # The tag of a value that was stored by an earlier version is that of now.
        ("on", SPEED),
        ([1, 2], SPEED),
        (1.5, SPEED),
        (-1, SPEED),
        ([1], FLOW),
        (7, FLOW),
    ],
)
def test_a_value_from_before_a_change_of_its_tag_is_left_out(value: Any, of: Tag) -> None:
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": [SPEED, LEVEL, FLOW]})
    list(made.births({"pump": True}, lambda: latest(reading(5, 10.0))))
    old = reading(value, 10.5, of)
    some = [reading(6, 11.0), reading(8, 11.0, LEVEL), old, reading(9, 12.0, LEVEL)]
    messages = list(made.data(some, latest, 0))
    found = [[metric.int_value for metric in payload(message).metrics] for message in messages]
    assert found == [[6, 8], [9]]
    assert made.unfit == [old]
    assert list(made.data([old], latest, 0)) == []
    assert made.unfit == [old]
    # No value fits any type.
    assert kinds(made.data([reading(None, 13.0, of, fault=2)], latest, 0)) == ["DDATA"]
    assert made.unfit == []


def test_a_birth_has_no_value_from_before_a_change_of_its_tag() -> None:
    made = EdgeNode(Names("group", "edge"), int)
    made.begin()
    made.adopt({"pump": [SPEED]})
    old = reading("on", 10.0, Tag("speed", "input_registers", 0, "string:2"))
    *_, birth = made.births({"pump": True}, lambda: latest(old))
    [metric] = payload(birth).metrics
    assert metric.is_null


class Pump:
    """A site with one device, which answers."""

    revision = answering_revision = 0
    retained: ClassVar[dict[tuple[str, str], str]] = {}
    standby: frozenset[str] = frozenset()

    def tags(self) -> dict[str, Any]:
        return {"pump": [SPEED]}

    def devices(self) -> dict[str, Any]:
        return {}

    def answering(self) -> dict[str, bool]:
        return {"pump": True}

    def latest(self) -> list[Reading]:
        return []

    def refresh(self) -> None:
        raise AssertionError("not called")

    def write(self, *_: object, **__: object) -> None:
        raise AssertionError("not called")


def test_an_output_refuses_what_is_left_out_and_publishes_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    published: list[Message] = []
    settings = {"type": "sparkplug", "url": "mqtt://h", "group": "g", "edge_node": "e"}
    output = SparkplugOutput("scada", SparkplugConfig.model_validate(settings), Pump())
    output.use_buffer(Buffer())
    monkeypatch.setattr(output, "_ready", lambda: output._node.adopt({"pump": [SPEED]}))
    monkeypatch.setattr(output, "_publish", lambda _, messages: published.extend(messages))
    with pytest.raises(Refused, match="before their tags were changed") as refused:
        output.send([reading("on", 1.0), reading(5, 2.0)])
    assert [each.value for each in refused.value.readings] == ["on"]
    assert kinds(published) == ["DBIRTH", "DDATA"]


@pytest.mark.parametrize(
    ("states", "online"),
    [
        ([(True, 5)], True),
        ([(True, 5), (False, 4)], True),
        ([(True, 5), (False, 5)], False),
        ([(False, 5), (True, 4)], False),
        ([(False, 5), (True, 5)], True),
    ],
)
def test_an_older_state_of_a_host_does_not_count(
    states: list[tuple[bool, int]], online: bool
) -> None:
    host = PrimaryHost()
    for state, timestamp in states:
        with contextlib.suppress(ValueError):
            host.take(b'{"online": %s, "timestamp": %d}' % (str(state).lower().encode(), timestamp))
    assert host.is_online is online


def test_the_state_of_a_host_is_unknown_in_a_new_connection() -> None:
    host = PrimaryHost()
    host.take(b'{"online": true, "timestamp": 5}')
    host.begin()
    assert not host.is_online
    host.take(b'{"online": false, "timestamp": 4}')
    with pytest.raises(ValueError, match=r"online, but 0\.001 s older than the last STATE message"):
        host.take(b'{"online": true, "timestamp": 4}')
    assert not host.is_online


def test_text_that_is_not_utf_8_is_an_error() -> None:
    datatype, _ = datatype_of(Tag("x", "holding_registers", 0, "string:4"))
    with pytest.raises(ValueError, match="not UTF-8"):
        value_of(parsed(b"\x12\x04\x7a\x02\xff\xfe").metrics[0], datatype)


@pytest.mark.parametrize("data", [b"\xff", b"\x12\x05\x0a", b"\x12\x02\x0a\xff"])
def test_a_malformed_payload_is_an_error(data: bytes) -> None:
    with pytest.raises(ValueError, match="not a Sparkplug B payload"):
        parsed(data)
