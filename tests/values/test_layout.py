"""Layouts: many fields of a block at once, as the fields one by one would be."""

from __future__ import annotations

import copy
import pickle
import re
import struct
from array import array
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast import values
from holdfast.values import Field, Layout, decode, encode, register_count
from support.cases import examples

ORDERS = ("ABCD", "DCBA", "BADC", "CDAB")
NUMBERS = (*(f"{sign}int{bits}" for sign in ("", "u") for bits in (16, 32, 64)), "float32")
TYPES = (*NUMBERS, "bool", *(f"bit:{bit}" for bit in range(16)), "bytes:5", "float64", "float16")
SIZE = 24


@st.composite
def layouts(draw: st.DrawFn) -> list[Field]:
    """Fields of a block of `SIZE` registers: with gaps, overlaps, arrays and all orders."""
    fields = []
    for index in range(draw(st.integers(1, 30))):
        name = draw(st.sampled_from(TYPES)) + draw(st.sampled_from(["", "[1]", "[3]"]))
        orders = (*ORDERS, "CDABGHEF") if "64" in name else ORDERS
        offset = draw(st.integers(0, SIZE - register_count(name)))
        fields.append(Field(f"f{index}", name, offset, draw(st.sampled_from(orders))))
    return fields


blocks = st.lists(st.integers(0, 65535), min_size=SIZE, max_size=SIZE)


@settings(max_examples=examples(60))
@given(layouts(), blocks)
def test_a_layout_decodes_as_its_fields_one_by_one(fields: list[Field], block: list[int]) -> None:
    layout = Layout(fields, size=SIZE)
    expected = {
        field.name: decode(
            block[field.offset : field.offset + register_count(field.type)], field.type, field.order
        )
        for field in fields
    }

    found = layout.decode(block)

    assert repr(found) == repr(expected)
    assert repr(layout.decode_tuple(block)) == repr(tuple(expected.values()))
    assert repr(layout.decode(struct.pack(f">{SIZE}H", *block))) == repr(expected)
    assert repr(layout.decode(array("H", block))) == repr(expected)


@settings(max_examples=examples(60))
@given(layouts(), blocks)
def test_a_layout_encodes_what_it_decodes(fields: list[Field], block: list[int]) -> None:
    layout = Layout(fields, size=SIZE)
    found = layout.decode(block)
    try:
        encoded = layout.encode(found, base=block)
    except values.InvalidLayout:
        taken = [bit for field in fields for bit in bits_of(field)]
        assert len(set(taken)) < len(taken)
    else:
        assert repr(layout.decode(encoded)) == repr(found)
        for field in fields:
            data = encoded[field.offset : field.offset + register_count(field.type)]
            assert repr(decode(data, field.type, field.order)) == repr(found[field.name])


def bits_of(field: Field) -> set[tuple[int, int]]:
    """The bits of a block that a field takes."""
    bits: set[tuple[int, int]] = set()
    for register in range(field.offset, field.offset + register_count(field.type)):
        kind, _, number = field.type.partition("[")[0].partition(":")
        places = range(16)
        if kind == "bit":
            swapped = field.order in ("DCBA", "BADC")
            places = range(bit := int(number) ^ 8 if swapped else int(number), bit + 1)
        bits |= {(register, place) for place in places}
    return bits


def test_a_layout_has_fields_of_every_kind_in_any_place() -> None:
    layout = Layout(
        [
            Field("serial", "string:6", 0, encoding="latin-1"),
            ("flow", "float32", 4, "CDAB"),
            ("flow low word", "uint16", 4),
            ("running", "bit:0", 7),
            ("alarm", "bit:15", 7),
            ("hours", "bcd32", 8),
            ("limits", "int16[2]", 10),
        ],
        size=14,
    )
    block = [*encode("X°12", "string:6", encoding="latin-1"), 0, *encode(1.5, "float32", "CDAB"), 0]
    block += [0x8000, 0x1234, 0x5678, 0xFFFF, 3, 0, 0]

    assert layout.names[:2] == ("serial", "flow")
    assert layout.size == 14
    assert layout.decode(block) == {
        "serial": "X°12",
        "flow": 1.5,
        "flow low word": 0,
        "running": False,
        "alarm": True,
        "hours": 12345678,
        "limits": [-1, 3],
    }


def test_the_offset_of_a_field_may_be_an_integer_of_any_library() -> None:
    class Integer:
        def __index__(self) -> int:
            return 3

    layout = Layout([("a", "uint16", Integer())], size=5)
    assert (layout.fields[0].offset, type(layout.fields[0].offset)) == (3, int)
    assert layout.encode({"a": 7}) == [0, 0, 0, 7, 0]


def test_a_layout_may_be_a_whole_area() -> None:
    assert Layout([("a", "uint16", 65535)]).size == 65536
    assert [Layout([("a", "uint32", 1)], size=size).size for size in (3, 4, 65536)] == [3, 4, 65536]


def test_a_layout_of_bools_decodes_bits() -> None:
    layout = Layout([("open", "bool", 0), ("doors", "bool[2]", 1)])

    assert layout.decode([True, False, 1]) == {"open": True, "doors": [False, True]}
    assert layout.encode({"open": True, "doors": [False, True]}) == [1, 0, 1]


def test_bits_of_one_register_are_encoded_into_it() -> None:
    layout = Layout([(f"b{bit}", f"bit:{bit}", 0) for bit in (0, 3, 15)])
    found = {"b0": True, "b3": False, "b15": True}

    assert layout.encode(found) == [0x8001]
    assert layout.encode(found, base=[0x00FF]) == [0x80F7]


def test_bits_of_both_orders_of_one_register_do_not_overlap_by_their_numbers() -> None:
    layout = Layout([("low", "bit:0", 0), ("high", "bit:0", 0, "BADC")])

    assert layout.encode({"low": False, "high": True}) == [0x0100]


def test_gaps_are_zero_or_as_in_the_base() -> None:
    layout = Layout([("a", "uint16", 1), ("b", "uint32", 4, "CDAB")], size=7)
    found = {"a": 1, "b": 0x00020003}

    assert layout.encode(found) == [0, 1, 0, 0, 3, 2, 0]
    assert layout.encode(found, base=[9] * 7) == [9, 1, 9, 9, 3, 2, 9]
    with pytest.raises(values.WrongLength, match=r"^the layout takes 7 registers, found 6$"):
        layout.encode(found, base=[9] * 6)


@pytest.mark.parametrize(
    "fields",
    [
        [("a", "uint32", 0), ("b", "uint16", 1)],
        [("a", "bytes:9", 0), ("x", "bit:0", 8), ("b", "bit:1", 3)],
        [("a", "bit:1", 0), ("b", "bit:1", 0)],
        [("a", "bit:1", 0), ("b", "bit:9", 0, "BADC")],
        [("a", "bit:1", 0), ("b", "bit:1", 0, "CDAB")],
        [("a", "bit:1", 0), ("b", "bit:9", 0, "DCBA")],
        [("a", "uint16", 0), ("b", "bool", 0)],
        [("a", "uint16", 0), ("b", "bit:15", 0)],
        [("a", "bit:1[3]", 0), ("b", "bit:1", 2)],
    ],
    ids=repr,
)
def test_fields_that_overlap_are_only_for_decoding(fields: list[Any]) -> None:
    layout = Layout(fields)
    found = layout.decode([0] * layout.size)

    with pytest.raises(values.InvalidLayout, match=r"^(a and b|b and a) overlap, so they can't be"):
        layout.encode(found)


# Errors name the field


@pytest.mark.parametrize(
    ("block", "text"),
    [
        ([0xFA, 0, 0x4141], "digits: digits 0x00FA are not bcd16, allowed: 0 to 9"),
        ([0, 0xFA, 0x4141], "more: values[0]: digits 0x00FA are not bcd16, allowed: 0 to 9"),
        ([0, 0, 0x41FF], r"name: b'A\xff' is not a string:2 in ascii"),
    ],
)
def test_a_field_that_can_not_be_decoded_is_named(block: list[int], text: str) -> None:
    layout = Layout([("digits", "bcd16", 0), ("more", "bcd16[1]", 1), ("name", "string:2", 2)])
    for convert in (layout.decode, layout.decode_tuple):
        with pytest.raises(values.Undecodable, match=f"^{re.escape(text)}$") as caught:
            convert(block)
        assert caught.value.field == text.partition(":")[0]


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"flow": 1e39}, values.DoesNotFit, "flow: 1e+39 is outside -3.4028234663852886e+38 to"),
        ({"limits": [1, -1]}, values.DoesNotFit, "limits: values[1]: -1 is outside 0 to 65535"),
        ({"limits": [1]}, values.WrongLength, "limits: uint16[2] takes 2 values, found 1"),
        ({"on": 5}, values.DoesNotFit, "on: 5 is not False, True, 0 or 1, which bit:4 requires"),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_its_field(
    change: dict[str, Any], error: type[values.ConversionError], text: str
) -> None:
    layout = Layout([("flow", "float32", 0), ("limits", "uint16[2]", 2), ("on", "bit:4", 5)])
    with pytest.raises(error, match=f"^{re.escape(text)}") as caught:
        layout.encode({"flow": 1.5, "limits": [1, 2], "on": True} | change)
    assert caught.value.field == next(iter(change))


def test_the_length_of_a_block_is_that_of_its_layout() -> None:
    layout = Layout([("a", "uint16", 3)])
    with pytest.raises(values.WrongLength, match=r"^the layout takes 4 registers, found 5$"):
        layout.decode([0] * 5)
    with pytest.raises(values.InvalidRegister, match=r"^registers\[1\]: True is not an integer$"):
        layout.decode([0, True, 0, 0])


def test_every_field_has_a_value_and_every_value_a_field() -> None:
    layout = Layout([("a", "uint16", 0), ("b", "uint16", 1)])
    with pytest.raises(values.DoesNotFit, match=r"^the value of b is missing$"):
        layout.encode({"a": 1, "c": 1})
    with pytest.raises(values.DoesNotFit, match=r"^the layout has no field 'c'$"):
        layout.encode({"a": 1, "b": 1, "c": 1})
    with pytest.raises(TypeError, match=r"^values are a list, allowed: a mapping"):
        layout.encode([1, 2])  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^values are None, allowed: a mapping"):
        layout.encode(None)  # type: ignore[arg-type]


def test_a_layout_can_be_copied() -> None:
    layout = Layout([("a", "uint16", 0), ("b", "float32", 2)], size=6)
    for copied in (pickle.loads(pickle.dumps(layout)), copy.deepcopy(layout)):
        assert copied.decode([1, 0, 0x3F80, 0, 0, 0]) == {"a": 1, "b": 1.0}


@pytest.mark.parametrize(
    ("fields", "error", "text"),
    [
        ([], values.InvalidLayout, "a layout requires at least one field"),
        (
            [("b", "bool", 0), ("a", "bool", 0), ("a", "bool", 0)],
            values.InvalidLayout,
            "two fields have the name 'a'",
        ),
        ([("a", "bool")], values.InvalidLayout, "a field is a tuple, allowed: a Field, or"),
        ([("a", "bool", 0, "ABCD", None, 0)], values.InvalidLayout, "a field is a tuple, allowed"),
        ([{"name": "a"}], values.InvalidLayout, "a field is a dict, allowed: a Field, or"),
        (
            [("", "bool", 0)],
            values.InvalidLayout,
            "the name of a field is '', allowed: non-empty text",
        ),
        (
            [(5, "bool", 0)],
            values.InvalidLayout,
            "the name of a field is 5, allowed: non-empty text",
        ),
        ([("a", "bool", -1)], values.InvalidLayout, "a: offset -1, allowed: 0 to 65535"),
        ([("a", "bool", 65536)], values.InvalidLayout, "a: offset 65536, allowed: 0 to 65535"),
        ([("a", "bool", True)], values.InvalidLayout, "a: offset True, allowed: 0 to 65535"),
        (
            [("a", "uint32", 65535)],
            values.InvalidLayout,
            "a: ends after 65537 registers, allowed: up to 65536",
        ),
        ([("a", "uint24", 0)], values.UnknownType, "a: type 'uint24' is unknown"),
        ([("a", "int16", 0, "XY")], values.UnknownOrder, "a: order 'XY' is unknown"),
        (
            [("a", "string:2", 0, "ABCD", "XY")],
            values.UnknownEncoding,
            "a: encoding 'XY' is unknown",
        ),
    ],
    ids=repr,
)
def test_fields_that_make_no_layout_are_refused(
    fields: Any, error: type[values.ConversionError], text: str
) -> None:
    with pytest.raises(error, match=f"^{re.escape(text)}"):
        Layout(fields)


@pytest.mark.parametrize("size", [2, 65537, True, 3.0])
def test_a_size_that_holds_not_all_fields_is_refused(size: Any) -> None:
    with pytest.raises(values.InvalidLayout, match=r"^size .*, allowed: 3 to 65536$"):
        Layout([("a", "uint16", 2)], size=size)
