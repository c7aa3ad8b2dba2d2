"""The byte interpreter: types, orders, forms of registers, and what is refused."""

from __future__ import annotations

import ctypes
import json
import math
import re
import struct
import sys
from array import array
from collections import deque
from decimal import Decimal
from fractions import Fraction
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast import values
from holdfast.values import ConversionError, codec_for, decode, encode, numeric, register_count
from holdfast.values.integers import as_boolean
from holdfast.values.orders import SWAPPED_BYTES
from holdfast.values.types import parsed
from support.cases import examples
from support.paths import VECTORS

CASES = json.loads((VECTORS / "values.json").read_text())
FOUR = ("ABCD", "DCBA", "BADC", "CDAB")
INTEGERS = {
    f"{sign}int{bits}": ((0, 2**bits - 1) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1))
    for bits in (16, 32, 64)
    for sign in ("", "u")
}
MAX_VALUE = {
    "float16": 65504.0,
    "float32": (2 - 2**-23) * 2.0**127,
    "float64": sys.float_info.max,
}
SIZES = {
    "bool": 2,
    **{f"bit:{bit}": 2 for bit in range(16)},
    **{name: int(name[-2:]) // 8 for name in INTEGERS | MAX_VALUE},
    "bcd16": 2,
    "bcd32": 4,
    **{f"string:{size}": size + size % 2 for size in (1, 5, 7, 8, 11)},
    **{f"bytes:{size}": size + size % 2 for size in (1, 5, 7, 8, 11)},
}
"""The bytes that types take in registers."""


def is_its_own_inverse(letters: str) -> bool:
    return all(
        letters["ABCDEFGH".index(letter)] == "ABCDEFGH"[at] for at, letter in enumerate(letters)
    )


EIGHT = [
    "".join(order)
    for words in permutations(("AB", "CD", "EF", "GH"))
    for swaps in range(16)
    for order in [[word[::-1] if swaps >> at & 1 else word for at, word in enumerate(words)]]
    if is_its_own_inverse("".join(order))
]


def orders_of(size: int) -> tuple[str, ...]:
    return (*FOUR, *EIGHT) if size == 8 else FOUR


def arranged(data: bytes, order: str) -> bytes:
    """The bytes of one field as an order puts them on the wire, by the words of its definition."""
    words = [data[at : at + 2] for at in range(0, len(data), 2)]
    if order == "ABCD":
        return data
    if order == "DCBA":
        return data[::-1]
    if order == "BADC":
        return b"".join(word[::-1] for word in words)
    if order == "CDAB":
        return b"".join(words[::-1])
    return bytes(data["ABCDEFGH".index(letter)] for letter in order)


def registers_of(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))


def single_values(name: str) -> st.SearchStrategy[Any]:
    base, _, size = name.partition(":")
    if base in INTEGERS:
        return st.integers(*INTEGERS[base])
    if base in MAX_VALUE:
        return st.floats(width=int(base[-2:]), allow_nan=False)  # type: ignore[arg-type]
    if base in ("bool", "bit"):
        return st.booleans()
    if base == "bcd16":
        return st.integers(0, 9999)
    if base == "bcd32":
        return st.integers(0, 99_999_999)
    if base == "bytes":
        return st.binary(min_size=int(size), max_size=int(size))
    ascii_texts = st.text(st.characters(max_codepoint=127), max_size=int(size))
    return ascii_texts.filter(lambda text: not text.endswith("\0"))


@st.composite
def typed(draw: st.DrawFn) -> tuple[str, str, Any]:
    """A type, perhaps an array, an order and a value of it."""
    name = draw(st.sampled_from(sorted(SIZES)))
    order = draw(st.sampled_from(orders_of(SIZES[name])))
    count = draw(st.none() | st.integers(1, 5))
    if count is None:
        return name, order, draw(single_values(name))
    elements = st.lists(single_values(name), min_size=count, max_size=count)
    return f"{name}[{count}]", order, draw(elements)


# Vectors


@pytest.mark.parametrize("case", CASES["cases"], ids=str)
def test_the_registers_of_a_vector_decode_to_its_value(case: dict[str, Any]) -> None:
    value = decode(case["registers"], case["type"], case["order"])

    assert (type(value), value) == (type(case["value"]), case["value"])


@pytest.mark.parametrize("case", CASES["cases"], ids=str)
def test_the_value_of_a_vector_encodes_to_its_registers(case: dict[str, Any]) -> None:
    assert encode(case["value"], case["type"], case["order"]) == case["registers"]


@pytest.mark.parametrize("case", CASES["errors"], ids=str)
def test_what_a_vector_says_is_wrong_is_refused(case: dict[str, Any]) -> None:
    convert, data = (decode, "registers") if case["op"] == "decode" else (encode, "value")
    with pytest.raises(ConversionError):
        convert(case[data], case["type"], case.get("order", "ABCD"))


# There and back


@given(typed())
def test_decode_undoes_encode(case: tuple[str, str, Any]) -> None:
    name, order, value = case

    registers = encode(value, name, order)

    assert len(registers) == register_count(name)
    assert repr(decode(registers, name, order)) == repr(value)


@pytest.mark.parametrize("name", SIZES)
@settings(max_examples=examples(20))
@given(data=st.data())
def test_every_order_puts_bytes_where_its_definition_says(name: str, data: st.DataObject) -> None:
    value = data.draw(single_values(name))
    plain = encode(value, name)
    for order in orders_of(SIZES[name]):
        wire = registers_of(arranged(struct.pack(f">{len(plain)}H", *plain), order))

        assert encode(value, name, order) == (plain if name == "bool" else wire)
        assert decode(wire, name, order) == value


@given(st.sampled_from([2, 4, 6, 8, 12]), st.data())
def test_an_order_applied_twice_changes_nothing(size: int, data: st.DataObject) -> None:
    order = data.draw(st.sampled_from(orders_of(size)))
    field = data.draw(st.binary(min_size=size, max_size=size))
    once = decode(registers_of(field), f"bytes:{size}", order)

    assert once == arranged(field, order)
    assert decode(registers_of(once), f"bytes:{size}", order) == field


@given(st.sampled_from(sorted(SIZES)), st.data())
def test_an_array_is_its_elements_one_after_the_other(name: str, data: st.DataObject) -> None:
    order = data.draw(st.sampled_from(orders_of(SIZES[name])))
    elements = data.draw(st.lists(single_values(name), min_size=1, max_size=5))
    registers = [register for value in elements for register in encode(value, name, order)]

    assert encode(elements, f"{name}[{len(elements)}]", order) == registers
    assert decode(registers, f"{name}[{len(elements)}]", order) == elements


@given(typed())
def test_all_forms_of_registers_decode_alike(case: tuple[str, str, Any]) -> None:
    name, order, value = case
    registers = encode(value, name, order)
    data = struct.pack(f">{len(registers)}H", *registers)
    native = array("H", registers)
    foreign = ctypes.c_uint16.__ctype_be__ * len(registers)
    little = ctypes.c_uint16.__ctype_le__ * len(registers)

    for form in (
        tuple(registers),
        deque(registers),
        data,
        bytearray(data),
        memoryview(data),
        memoryview(data).cast("c"),
        native,
        memoryview(native),
        memoryview(array("H", registers[::-1]))[::-1],
        foreign(*registers),
        little(*registers),
    ):
        assert repr(decode(form, name, order)) == repr(value)


def test_a_numpy_array_of_uint16_is_registers_in_any_byte_order() -> None:
    numpy = pytest.importorskip("numpy")
    for form in ("=u2", "<u2", ">u2"):
        assert decode(numpy.array([17530, 2], form), "uint32") == 17530 * 65536 + 2
    assert decode(numpy.array([1, 9, 2, 9], "u2")[::2], "uint16[2]") == [1, 2]
    assert decode(numpy.array([True, False]), "bool[2]") == [True, False]
    assert encode(numpy.array([1.5, 2.5], "f4"), "float32[2]") == encode([1.5, 2.5], "float32[2]")
    assert encode(numpy.float32(1.5), "float32") == encode(1.5, "float32")
    assert encode(numpy.int16(-2), "int32") == encode(-2, "int32")
    with pytest.raises(TypeError, match="format 'l'"):
        decode(numpy.array([1, 2]), "uint32")


def test_numpy_booleans_are_bits_beside_those_of_python() -> None:
    numpy = pytest.importorskip("numpy")
    yes, no = numpy.bool_(True), numpy.bool_(False)
    assert decode([yes, 0, no, True, 1], "bool[5]") == [True, False, False, True, True]
    assert (encode(yes, "bool"), encode(no, "bit:3")) == ([1], [0xFFFF ^ 8])
    for wrong in ([yes, -1], [True, -1]):
        with pytest.raises(values.InvalidRegister, match=r"^registers\[1\]: -1 is outside 0 to"):
            decode(wrong, "bool[2]")
    with pytest.raises(values.InvalidRegister, match=r"^registers\[0\]: a bool_? is not an int"):
        decode([yes], "uint16")


@pytest.mark.parametrize(("module", "name"), [("numpy", "bool"), ("numpy", "bool_")])
def test_a_boolean_of_any_version_of_numpy_is_one(module: str, name: str) -> None:
    kind = type(name, (), {"__module__": module, "__bool__": lambda _: False})
    assert as_boolean(kind()) is False
    assert as_boolean(type(name, (), {"__module__": "other"})()) is None
    assert as_boolean(type("int64", (), {"__module__": module})()) is None


def test_the_package_does_not_import_numpy() -> None:
    files = list(Path(values.__path__[0]).glob("*.py"))

    assert files
    assert [file for file in files if re.search(r"(import|from) numpy", file.read_text())] == []


@pytest.mark.parametrize(("machine", "number"), [("little", 0x0100), ("big", 0x0001)])
def test_integers_without_a_byte_order_have_that_of_the_machine(
    monkeypatch: pytest.MonkeyPatch, machine: str, number: int
) -> None:
    numpy = pytest.importorskip("numpy")
    data = b"\x00\x01"
    native = memoryview(data)
    big, little = ctypes.c_uint16.__ctype_be__ * 1, ctypes.c_uint16.__ctype_le__ * 1
    unaligned = memoryview(numpy.frombuffer(b"?" + data, "u2", offset=1))
    forms = (native.cast("H"), native.cast("@H"), unaligned)
    monkeypatch.setattr(sys, "byteorder", machine)
    assert [form.format for form in forms] == ["H", "@H", "=H"]
    assert [decode(form, "uint16") for form in forms] == [number] * 3
    assert [decode(form, "uint16") for form in (big(7), little(7))] == [7, 7]


# Types


def test_the_name_of_a_type_has_up_to_four_parts() -> None:
    whole, single = parsed("string:5[3]"), parsed("uint16")
    assert (whole.element, whole.base, whole.parameter) == ("string:5", "string", 5)
    assert (whole.width, whole.count, whole.registers) == (6, 3, 9)
    assert (single.element, single.base, single.parameter) == ("uint16", "uint16", 0)
    assert (single.width, single.count, single.registers) == (2, None, 1)


@pytest.mark.parametrize(("name", "size"), SIZES.items())
def test_a_type_takes_whole_registers(name: str, size: int) -> None:
    assert register_count(name) == size // 2
    assert register_count(f"{name}[7]") == 7 * size // 2


def test_a_field_may_take_a_whole_area_and_no_more() -> None:
    assert register_count("bool[65536]") == 65536
    assert register_count("string:131072") == 65536


@pytest.mark.parametrize(
    "name",
    [
        *("uint24", "Int16", "INT16", " int16", "int16 ", "int16\n", "", "int", "float", "bit"),
        *("bit:16", "bit:-1", "bit:01", "bit:٣", "bit:", "string", "string:", "string:1.5"),
        *("bytes", "uint16:2", "float32[]", "float32[-1]", "float32[1][2]", "[3]", "bcd64"),
        *("bool:1", "int16[9999999]", "int16[01]", 5, None, ("int16",)),
    ],
    ids=repr,
)
def test_an_unknown_type_is_refused_with_all_that_are_allowed(name: Any) -> None:
    allowed = r"bit:0 to bit:15, bool, int16.*float64, bcd16, bcd32, string:N, bytes:N.*float32\[10"
    for convert in (register_count, lambda name: decode([1], name), lambda name: encode(1, name)):
        with pytest.raises(values.UnknownType, match=rf"^type .* is unknown.*{allowed}"):
            convert(name)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        *(("BIT", "bit:0"), ("boolean", "bool"), ("Bytes", "bytes:8"), ("char", "string:8")),
        *(("DOUBLE", "float64"), ("dint", "int32"), ("dword", "uint32"), ("float", "float32")),
        *(("INT", "int16"), ("long", "int32"), ("real", "float32"), ("short", "int16")),
        *(("string", "string:8"), ("udint", "uint32"), ("uint", "uint16"), ("WORD", "uint16")),
        *(("u16", "uint16"), ("I32", "int32"), ("f64", "float64"), ("f16", "float16")),
        *(("flaot32", "float32"), ("unit64", "uint64")),
        *(("ushort", "uint16"), ("lreal", "float64"), ("ulint", "uint64"), ("lint", "int64")),
        *(("iunt16", "uint16"), ("sint16", "int16"), ("float 32", "float32"), ("s16", "int16")),
        *(("float23", "float32"), ("uint61", "uint16")),
        *(("bit3", "bit:3"), ("bit.3", "bit:3"), ("Bit:3", "bit:3"), ("bit7[2]", "bit:7[2]")),
        *(("String:20", "string:20"), ("string20", "string:20"), ("STRING[20]", "string:20")),
        *(
            ("Bytes4", "bytes:4"),
            ("bytes[4]", "bytes:4"),
            ("INTEGER", "int16"),
            ("unsigned long", "uint32"),
            ("String:5[3]", "string:5[3]"),
        ),
        *(("flaot32[5]", "float32[5]"), ("real[5]", "float32[5]"), ("real[x", "float32")),
    ],
)
def test_a_type_of_another_program_is_suggested_as_it_is_called_here(name: str, meant: str) -> None:
    with pytest.raises(values.UnknownType, match=rf"; did you mean {re.escape(repr(meant))}\?$"):
        register_count(name)


def test_no_type_is_suggested_for_a_long_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.values.types._meant", lambda _: pytest.fail("it is compared"))
    with pytest.raises(values.UnknownType, match=r"^type 'float3.*'… is .* arrays: float32\[10\]$"):
        register_count("float3" * 100_000)


@pytest.mark.parametrize("name", ["qqqqqq", "sint", "USINT", "uint8", "uint24", "byte", "bit16"])
def test_no_type_is_suggested_for_what_is_like_none(name: str) -> None:
    with pytest.raises(values.UnknownType, match=r"arrays: float32\[10\]$"):
        register_count(name)


@pytest.mark.parametrize(
    ("name", "registers"),
    [
        ("float32[0]", 0),
        ("string:0", 0),
        ("bytes:0", 0),
        ("uint16[65537]", 65537),
        ("string:131073", 65537),
        ("bytes:999999[999999]", 500_000 * 999_999),
    ],
)
def test_a_type_without_registers_or_with_too_many_is_refused(name: str, registers: int) -> None:
    text = f"type '{name}' would take {registers} registers, allowed: 1 to 65536"
    with pytest.raises(values.UnknownType, match=f"^{re.escape(text)}$"):
        register_count(name)


# Orders


def test_76_spellings_of_eight_bytes_are_their_own_inverse() -> None:
    assert len(EIGHT) == 76
    for order in EIGHT:
        assert encode(decode([1, 2, 3, 4], "uint64", order), "uint64", order) == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("four", "eight"),
    list(zip(FOUR, ["ABCDEFGH", "HGFEDCBA", "BADCFEHG", "GHEFCDAB"], strict=True)),
)
def test_four_letters_follow_a_field_of_eight_bytes(four: str, eight: str) -> None:
    assert encode(0x0102030405060708, "int64", four) == encode(0x0102030405060708, "int64", eight)


def test_a_register_alone_is_only_swapped() -> None:
    assert [encode(0x1234, "uint16", order) for order in FOUR] == [
        [0x1234],
        [0x3412],
        [0x3412],
        [0x1234],
    ]
    assert decode([0x0100], "bit:0", "BADC") is True


def test_an_order_is_that_of_the_whole_string() -> None:
    texts = {
        order: bytes.fromhex("".join(f"{r:04x}" for r in encode("HELLO", "string:5", order)))
        for order in FOUR
    }

    assert texts == {"ABCD": b"HELLO\0", "DCBA": b"\0OLLEH", "BADC": b"EHLL\0O", "CDAB": b"O\0LLHE"}


@pytest.mark.parametrize(
    "order", ["ABDC", "abcd", "", "AB", "ABCDEF", "A B C D ", 5, None], ids=repr
)
def test_an_unknown_order_is_refused_with_those_that_are_allowed(order: Any) -> None:
    allowed = "allowed: ABCD, DCBA, BADC, CDAB, and eight letters such as GHEFCDAB"
    for convert in (decode, encode):
        with pytest.raises(values.UnknownOrder, match=rf"^order .* is unknown, {allowed}"):
            convert([1], "uint16", order)


@pytest.mark.parametrize(
    ("order", "meant"),
    [
        ("abcd", "ABCD"),
        ("big", "ABCD"),
        ("Big-Endian", "ABCD"),
        ("le", "DCBA"),
        ("LE_BE", "BADC"),
        ("BE_LE", "CDAB"),
        ("word swap", "CDAB"),
        ("WORDSWAP", "CDAB"),
        ("byte-swap", "BADC"),
        ("BYTESWAP", "BADC"),
    ],
)
def test_an_order_as_other_programs_call_it_is_suggested(order: str, meant: str) -> None:
    with pytest.raises(values.UnknownOrder, match=rf"is unknown, .*; did you mean '{meant}'\?$"):
        decode([1, 2], "uint32", order)


@pytest.mark.parametrize("order", ["little", "LITTLE", "little_endian", "mixed"])
def test_a_word_that_names_several_orders_suggests_none(order: str) -> None:
    with pytest.raises(values.UnknownOrder, match=r"is unknown, .* for eight bytes$"):
        decode([1, 2], "uint32", order)


@pytest.mark.parametrize(
    ("order", "name", "text"),
    [
        (
            "ABCDEFGG",
            "uint64",
            "order ABCDEFGG is unknown, allowed with eight letters: A to H once each",
        ),
        (
            "abcdefgh",
            "uint64",
            "order abcdefgh is unknown, allowed with eight letters: A to H once each",
        ),
        (
            "ACBDEFGH",
            "uint64",
            "order ACBDEFGH splits a register, allowed: AB, CD, EF and GH together",
        ),
        (
            "CDEFGHAB",
            "uint64",
            "order CDEFGHAB is not its own inverse, allowed: bytes that stay or swap places, "
            "as in CDABEFGH",
        ),
        ("GHEFCDAB", "uint32", "order GHEFCDAB is for 8 bytes, uint32 has 4"),
        ("GHEFCDAB", "string:5[2]", "order GHEFCDAB is for 8 bytes, string:5 has 6"),
        ("GHEFCDAB", "bool", "order GHEFCDAB is for 8 bytes, bool has 2"),
    ],
)
def test_eight_letters_that_are_no_order_of_the_field_are_refused(
    order: str, name: str, text: str
) -> None:
    with pytest.raises(values.UnknownOrder, match=f"^{text}$"):
        decode([], name, order)


@pytest.mark.parametrize("name", [name for name, size in SIZES.items() if size != 8])
def test_eight_letters_are_only_for_eight_bytes(name: str) -> None:
    text = f"order GHEFCDAB is for 8 bytes, {name} has {SIZES[name]}"
    with pytest.raises(values.UnknownOrder, match=f"^{text}$"):
        decode([], name, "GHEFCDAB")


def test_the_orders_that_swap_the_bytes_of_a_register_are_known() -> None:
    assert {each for each in FOUR if encode(1, "uint16", each) == [256]} == set(SWAPPED_BYTES)


# Areas


def test_in_an_area_of_bits_there_are_only_bools() -> None:
    assert codec_for("coils", "bool[2]").encode([True, False]) == [1, 0]
    assert codec_for("discrete_inputs", "bool").encode(1) == [1]
    with pytest.raises(values.WrongArea, match=r"^type is 'uint16', allowed in coils: bool$"):
        codec_for("coils", "uint16")
    with pytest.raises(values.WrongArea, match=r"allowed in discrete_inputs: bool$"):
        codec_for("discrete_inputs", "bit:0")


def test_in_registers_there_are_all_types() -> None:
    assert codec_for("holding_registers", "uint16", "BADC").encode(1) == [256]
    assert codec_for("input_registers", "bool").encode(True) == [1]
    latin = codec_for("holding_registers", "string:2", encoding="latin-1")
    assert latin.encode("°") == [0xB000]
    with pytest.raises(values.UnknownOrder):
        codec_for("holding_registers", "uint16", "ABDC")


# Registers


@pytest.mark.parametrize(
    ("registers", "name", "text"),
    [
        ([1], "uint32", "uint32 takes 2 registers, found 1"),
        ([1, 2], "uint16", "uint16 takes 1 register, found 2"),
        ([], "bool[2]", "bool[2] takes 2 registers, found 0"),
        (b"abc", "uint32", "uint32 takes 2 registers (4 bytes), found 3 bytes"),
        (b"a", "uint16", "uint16 takes 1 register (2 bytes), found 1 byte"),
        (array("H", [1]), "string:3", "string:3 takes 2 registers (4 bytes), found 2 bytes"),
    ],
    ids=repr,
)
def test_a_wrong_length_is_refused(registers: Any, name: str, text: str) -> None:
    with pytest.raises(values.WrongLength, match=f"^{re.escape(text)}$"):
        decode(registers, name)


@pytest.mark.parametrize(
    ("register", "text"),
    [
        (65536, "65536 is outside 0 to 65535"),
        (-1, "-1 is outside 0 to 65535"),
        (10**5000, "an integer of 16610 bits is outside 0 to 65535"),
        (1.0, "1.0 is not an integer"),
        ("1", "'1' is not an integer"),
        ("x" * 50, f"'{'x' * 40}'… is not an integer"),
        (None, "None is not an integer"),
        ([1], "a list is not an integer"),
        (True, "True is not an integer"),
    ],
    ids=lambda value: repr(value)[:20] if value != 10**5000 else "huge",
)
@pytest.mark.parametrize("form", [list, tuple, deque])
def test_a_register_is_an_integer_of_16_bits(register: Any, text: str, form: Any) -> None:
    with pytest.raises(values.InvalidRegister, match=rf"^registers\[1\]: {re.escape(text)}$"):
        decode(form([0, register]), "uint32")


class Endless:
    """Items without an end."""

    def __getitem__(self, at: int) -> int:
        return at


@pytest.mark.parametrize(
    ("registers", "found"),
    [
        (None, "None"),
        (5, "5"),
        ("ab", "'ab'"),
        ({0: 1, 1: 2}, "a dict"),
        ({1, 2}, "a set"),
        (iter([1, 2]), "a list_iterator"),
        (array("h", [1, 2]), "a buffer of format 'h', dimensions 1"),
        (array("d", [1, 2]), "a buffer of format 'd', dimensions 1"),
        (memoryview(bytes(4)).cast("B", (2, 2)), "a buffer of format 'B', dimensions 2"),
        (memoryview(bytes(8)).cast("H", (2, 2)), "a buffer of format 'H', dimensions 2"),
        (memoryview(bytes(4)).cast("?", (2, 2)), "a buffer of format '?', dimensions 2"),
        (Endless(), "a Endless"),
    ],
    ids=lambda each: each if isinstance(each, str) else type(each).__name__,
)
def test_what_is_no_sequence_of_registers_is_a_type_error(registers: Any, found: str) -> None:
    allowed = "allowed: a sequence of integers, bytes, or a buffer of bytes or of unsigned 16"
    with pytest.raises(TypeError, match=f"^registers are {re.escape(found)}, {allowed}"):
        decode(registers, "uint32")


# Bits


def test_bits_of_a_bit_area_are_bools() -> None:
    assert decode([1], "bool") is True
    assert decode([False, True, 0], "bool[3]") == [False, True, False]
    assert decode((ctypes.c_bool * 2)(True, False), "bool[2]") == [True, False]
    assert encode([False, True], "bool[2]") == [0, 1]


def test_a_register_that_is_not_zero_is_true() -> None:
    assert decode([0x0100, 0, 2], "bool[3]") == [True, False, True]


@given(st.integers(0, 65535), st.integers(0, 15))
def test_bit_0_is_the_least_significant(register: int, bit: int) -> None:
    assert decode([register], f"bit:{bit}") is bool(register >> bit & 1)


@given(st.integers(0, 65535), st.integers(0, 15))
def test_a_bit_encodes_to_a_mask_that_changes_no_other(register: int, bit: int) -> None:
    assert register | encode(True, f"bit:{bit}")[0] == register | 1 << bit
    assert register & encode(False, f"bit:{bit}")[0] == register & ~(1 << bit)


@pytest.mark.parametrize("name", ["bool", "bit:3"])
@pytest.mark.parametrize("value", [2, -1, 1.0, "true", None, 10**5000], ids=lambda _: "")
def test_a_truth_value_is_a_bool_or_a_bit(name: str, value: Any) -> None:
    assert encode(1, name) == encode(True, name)
    with pytest.raises(
        values.DoesNotFit, match=f"is not False, True, 0 or 1, which {name} requires$"
    ):
        encode(value, name)


# Numbers


@pytest.mark.parametrize(("name", "bounds"), INTEGERS.items())
def test_an_integer_outside_its_type_is_refused(name: str, bounds: tuple[int, int]) -> None:
    least, most = bounds
    for value in (least, most):
        assert decode(encode(value, name), name) == value
    for value in (least - 1, most + 1, 10**5000, -(10**5000)):
        with pytest.raises(values.DoesNotFit, match=rf" is outside {least} to {most} of {name}$"):
            encode(value, name)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_message_has_integers_of_up_to_128_bits(sign: int) -> None:
    with pytest.raises(values.DoesNotFit, match=rf"^{sign * (2**128 - 1)} is outside"):
        encode(sign * (2**128 - 1), "uint64")
    with pytest.raises(values.DoesNotFit, match=r"^an integer of 129 bits is outside"):
        encode(sign * 2**128, "uint64")


@pytest.mark.parametrize("name", [*INTEGERS, "bcd16", "bcd32"])
@pytest.mark.parametrize(
    "value", [True, False, 1.0, 1.5, math.nan, math.inf, "1", b"1", None, [1], 1j], ids=repr
)
def test_what_is_no_integer_is_refused(name: str, value: Any) -> None:
    with pytest.raises(values.DoesNotFit, match=f" is not an integer, which {name} requires$"):
        encode(value, name)


@pytest.mark.parametrize("name", MAX_VALUE)
@pytest.mark.parametrize(
    "value", [True, False, "1", b"1", None, [1.0], 1j, Decimal("sNaN")], ids=repr
)
def test_what_is_no_number_is_refused(name: str, value: Any) -> None:
    with pytest.raises(values.DoesNotFit, match=f" is not a number, which {name} requires$"):
        encode(value, name)


@pytest.mark.parametrize(("name", "most"), MAX_VALUE.items())
def test_a_float_too_large_is_refused_and_no_infinity(name: str, most: float) -> None:
    beyond: list[Any] = (
        [10**400, Fraction(10**400)]
        if name == "float64"
        else [most * 1.01, 1e300, Fraction(10**400), Decimal("1e999999")]
    )
    for value in (most, -most):
        assert decode(encode(value, name), name) == value
    for value in (*beyond, *(-value for value in beyond)):
        text = re.escape(f" is outside {-most} to {most} of {name}")
        with pytest.raises(values.DoesNotFit, match=f"{text}$"):
            encode(value, name)
        with pytest.raises(values.DoesNotFit, match=rf"^values\[1\]: .*{text}$"):
            encode([0.0, value], f"{name}[2]")


LEAST_VALUE = {"float16": 2.0**-24, "float32": 2.0**-149, "float64": 5e-324}


@pytest.mark.parametrize(("name", "least"), LEAST_VALUE.items())
def test_a_number_that_would_be_0_is_refused(name: str, least: float) -> None:
    small: list[Any] = [least / 2, 1e-300, Fraction(least) / 3, Decimal("1e-999999")]
    if name == "float64":
        small = [Fraction(1, 10**400)]
    for value in (0.0, -0.0, least, -least):
        assert decode(encode(value, name), name) == value
        assert decode(encode([value, math.nan], f"{name}[2]"), f"{name}[2]")[0] == value
    for value in (*small, *(-value for value in small)):
        text = f" is too small for {name}, which would hold 0"
        with pytest.raises(values.DoesNotFit, match=f"{text}$"):
            encode(value, name)
        with pytest.raises(values.DoesNotFit, match=rf"^values\[1\]: .*{text}$"):
            encode([0.0, value, math.nan], f"{name}[3]")


@pytest.mark.parametrize("order", FOUR)
@pytest.mark.parametrize("name", MAX_VALUE)
def test_floats_hold_infinities_and_nan(name: str, order: str) -> None:
    for value in (math.inf, -math.inf):
        assert decode(encode(value, name, order), name, order) == value
    assert math.isnan(decode(encode(math.nan, name, order), name, order))


def test_a_float_may_be_given_as_any_real_number() -> None:
    assert encode(2, "float32") == encode(2.0, "float32")
    assert encode(Fraction(1, 2), "float32") == encode(0.5, "float32")
    assert encode(Decimal("-0.1"), "float32") == encode(-0.1, "float32")
    assert encode([Decimal("NaN"), Decimal("Infinity")], "float64[2]") == encode(
        [math.nan, math.inf], "float64[2]"
    )
    assert encode([Fraction(1, 2), 2, 0.5], "float16[3]") == encode([0.5, 2.0, 0.5], "float16[3]")


@pytest.mark.parametrize(("name", "step"), [("float16", 2.0**-10), ("float32", 2.0**-23)])
def test_a_number_with_more_digits_than_a_float_is_rounded_once(name: str, step: float) -> None:
    middle, little = 1 + Fraction(step) / 2, Fraction(1, 2**60)
    pairs: list[tuple[Fraction | int, float]] = [
        (middle - little, 1.0),
        (middle, 1.0),
        (middle + little, 1 + step),
    ]
    if name == "float32":
        pairs += [(int(2**60 * middle) + 1, 2**60 * (1 + step)), (int(2**60 * middle) - 1, 2.0**60)]
        pairs.append((2**128 - 2**103 - 1, MAX_VALUE[name]))
    for value, nearest in pairs:
        for sign in (1, -1):
            assert decode(encode(sign * value, name), name) == sign * nearest
            assert decode(encode([0.5, sign * value], f"{name}[2]"), f"{name}[2]")[1] == (
                sign * nearest
            )


def test_numbers_that_a_float_holds_are_packed_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numeric.Float, "pack_one", None)
    for most in (2**53, -(2**53)):
        assert decode(encode([1, 2.5, most], "float32[3]"), "float32[3]") == [1.0, 2.5, most]


def test_an_integer_may_be_of_any_library() -> None:
    class Integer:
        def __index__(self) -> int:
            return 70000

    assert encode(Integer(), "uint32") == encode(70000, "uint32")
    assert encode([1, Integer()], "uint32[2]") == encode([1, 70000], "uint32[2]")
    with pytest.raises(values.DoesNotFit, match="70000 is outside"):
        encode(Integer(), "uint16")


@pytest.mark.parametrize(
    ("name", "most"), [("bcd16", 9999), ("bcd32", 99_999_999)], ids=["bcd16", "bcd32"]
)
def test_a_number_of_too_many_digits_is_refused(name: str, most: int) -> None:
    assert decode(encode(most, name), name) == most
    for value in (-1, most + 1, 10**5000):
        with pytest.raises(values.DoesNotFit, match=f" is outside 0 to {most} of {name}$"):
            encode(value, name)


@pytest.mark.parametrize("nibble", range(4))
@pytest.mark.parametrize("digit", range(10, 16))
def test_a_digit_over_9_is_refused(nibble: int, digit: int) -> None:
    register = digit << 4 * nibble

    with pytest.raises(
        values.Undecodable, match=f"^digits 0x{register:04X} are not bcd16, allowed: 0 to 9$"
    ):
        decode([register], "bcd16")
    with pytest.raises(values.Undecodable, match=r"^values\[1\]: digits 0x0000.... are not bcd32"):
        decode([0, 0, register, 0], "bcd32[2]", "CDAB")


# Texts


def test_a_text_is_padded_with_nul() -> None:
    assert encode("AB", "string:5") == [0x4142, 0, 0]
    assert decode([0x4142, 0, 0], "string:5") == "AB"
    assert decode([0, 0, 0], "string:5") == ""


def test_nul_inside_a_text_is_kept() -> None:
    assert decode([0x4100, 0x4200], "string:4") == "A\0B"


def test_the_odd_byte_after_a_field_is_not_read() -> None:
    assert decode([0x4142, 0x43FF], "string:3") == "ABC"
    assert decode([0x4142, 0x43FF], "bytes:3") == b"ABC"


@pytest.mark.parametrize(
    "encoding", ["utf-8", "latin-1", "cp1252", "utf-16", "utf-16-le", "utf-16-be", "shift_jis"]
)
@pytest.mark.parametrize("order", FOUR)
def test_a_text_has_the_encoding_that_is_given(encoding: str, order: str) -> None:
    text = "ポンプ" if encoding == "shift_jis" else "5 °C"
    registers = encode(text, "string:20", order, encoding=encoding)

    assert decode(registers, "string:20", order, encoding=encoding) == text
    assert arranged(struct.pack(">10H", *registers), order).startswith(text.encode(encoding))


@pytest.mark.parametrize(
    ("value", "encoding", "text"),
    [
        ("HELLO", None, "'HELLO' has 5 bytes in ascii, allowed in string:4: up to 4"),
        ("°°°", "utf-8", "'°°°' has 6 bytes in utf-8, allowed in string:4: up to 4"),
        ("°", None, "'°' can't be encoded in ascii"),
        ("A\0", None, r"'A\x00' would be read back as 'A'"),
        (b"A", None, "b'A' is not text, which string:4 requires"),
        (5, None, "5 is not text, which string:4 requires"),
    ],
    ids=repr,
)
def test_a_text_that_does_not_fit_is_refused(value: Any, encoding: str | None, text: str) -> None:
    with pytest.raises(values.DoesNotFit, match=f"^{re.escape(text)}$"):
        encode(value, "string:4", encoding=encoding)


def test_bytes_that_are_no_text_are_refused() -> None:
    with pytest.raises(values.Undecodable, match=r"^b'A\\xff' is not a string:2 in ascii$"):
        decode([0x41FF], "string:2")
    with pytest.raises(
        values.Undecodable, match=r"^values\[1\]: b'A\\xff' is not a string:2 in utf-8$"
    ):
        decode([0x4141, 0x41FF], "string:2[2]", encoding="utf-8")
    with pytest.raises(values.Undecodable, match="is not a string:6 in utf-7"):
        decode([0x2B32, 0x4141, 0x2D00], "string:6", encoding="utf-7")


@pytest.mark.parametrize(
    ("name", "encoding", "text"),
    [
        ("string:4", "nonsense", "encoding 'nonsense' is unknown"),
        ("string:4", "", "encoding '' is unknown"),
        ("string:4", "a\0b", r"encoding 'a\x00b' is unknown"),
        ("string:4", "rot13", "encoding 'rot13' is unknown"),
        (
            "string:5",
            "utf-16-le",
            "encoding utf-16-le can't pad with NUL to the 5 bytes of string:5",
        ),
        ("uint16[2]", "ascii", "encoding 'ascii' is for strings, not for uint16[2]"),
    ],
)
def test_an_encoding_that_can_not_be_is_refused(name: str, encoding: str, text: str) -> None:
    with pytest.raises(values.UnknownEncoding, match=f"^{re.escape(text)}$"):
        decode([0, 0], name, encoding=encoding)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (b"AB", "found 2 bytes, bytes:3 requires 3"),
        (b"ABCD", "found 4 bytes, bytes:3 requires 3"),
        ("ABC", "'ABC' is not bytes, which bytes:3 requires"),
        ([65, 66, 67], "a list is not bytes, which bytes:3 requires"),
    ],
    ids=repr,
)
def test_bytes_are_of_one_length(value: Any, text: str) -> None:
    assert encode(bytearray(b"ABC"), "bytes:3") == encode(memoryview(b"ABC"), "bytes:3")
    with pytest.raises(values.DoesNotFit, match=f"^{text}$"):
        encode(value, "bytes:3")


# Arrays


@pytest.mark.parametrize(
    "form", [list, tuple, deque, lambda items: array("i", items), lambda items: range(items[0], 4)]
)
def test_the_values_of_an_array_are_any_sequence(form: Any) -> None:
    assert encode(form([1, 2, 3]), "int16[3]") == [1, 2, 3]
    assert decode([1, 2, 3], "int16[3]") == [1, 2, 3]


def test_an_array_of_one_is_no_single_value() -> None:
    assert decode([5], "uint16[1]") == [5]
    with pytest.raises(
        values.DoesNotFit,
        match=r"^5 is not a sequence, which uint16\[1\] "
        "requires$",
    ):
        encode(5, "uint16[1]")


@pytest.mark.parametrize("value", ["ab", b"ab", bytearray(b"ab"), {1: 2, 2: 3}, None], ids=repr)
def test_what_is_no_sequence_is_no_array(value: Any) -> None:
    with pytest.raises(values.DoesNotFit, match=r" is not a sequence, which uint16\[2\] requires$"):
        encode(value, "uint16[2]")


def test_an_array_has_all_its_values() -> None:
    with pytest.raises(values.WrongLength, match=r"^float32\[2\] takes 2 values, found 3$"):
        encode([1, 2, 3], "float32[2]")
    with pytest.raises(values.WrongLength, match=r"^int16\[1\] takes 1 value, found 0$"):
        encode([], "int16[1]")


@pytest.mark.parametrize(
    ("name", "items", "text"),
    [
        ("uint16[3]", [1, 2, 65536], "values[2]: 65536 is outside 0 to 65535 of uint16"),
        ("uint16[2]", [1, True], "values[1]: True is not an integer, which uint16 requires"),
        ("uint64[2]", [1.0, 1], "values[0]: 1.0 is not an integer, which uint64 requires"),
        ("float32[2]", [1.0, True], "values[1]: True is not a number, which float32 requires"),
        ("bool[2]", [True, 2], "values[1]: 2 is not False, True, 0 or 1, which bool requires"),
        ("bcd16[2]", [1, 10000], "values[1]: 10000 is outside 0 to 9999 of bcd16"),
        (
            "string:1[2]",
            ["A", "AB"],
            "values[1]: 'AB' has 2 bytes in ascii, allowed in string:1: up to 1",
        ),
    ],
    ids=repr,
)
def test_a_value_of_an_array_is_refused_with_its_place(
    name: str, items: list[Any], text: str
) -> None:
    with pytest.raises(values.DoesNotFit, match=f"^{re.escape(text)}$"):
        encode(items, name)


@pytest.mark.parametrize("order", FOUR)
def test_a_long_array_decodes_as_its_elements_do(order: str) -> None:
    numbers = [float(number) for number in range(-5000, 5000)]
    registers = encode(numbers, "float32[10000]", order)

    assert decode(registers, "float32[10000]", order) == numbers
    assert decode(registers[100:102], "float32", order) == numbers[50]
