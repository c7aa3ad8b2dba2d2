"""Values of many tags from the bytes of blocks, and of one tag from several blocks."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.tags import Tag
from holdfast.tags.decoding import Places, Undecoded, assembled, decoder, value_of

if TYPE_CHECKING:
    from collections.abc import Iterator


def register(name: str, address: int, kind: str = "uint16", **more: Any) -> Tag:
    return Tag(name, "holding_registers", address, kind, **more)


def coil(address: int, kind: str = "bool") -> Tag:
    return Tag("c", "coils", address, kind)


def registers(*numbers: int) -> bytes:
    return struct.pack(f">{len(numbers)}H", *numbers)


BITS = b"\x05\x81\x02"
"""Coils 0, 2, 8, 15 and 17 are on."""

SET = (0, 2, 8, 15, 17)


@pytest.mark.parametrize("address", [0, 30])
def test_bits_are_packed_from_the_lowest_of_each_byte(address: int) -> None:
    tags = [coil(address + bit) for bit in range(24)]
    expected = [bit in SET for bit in range(24)]
    assert list(decoder(tags, address, 24)(BITS)) == expected
    assert [value_of(tag, BITS, address) for tag in tags] == expected


@given(st.binary(min_size=32, max_size=32))
def test_a_bit_of_any_byte_is_that_of_its_number(data: bytes) -> None:
    number = int.from_bytes(data, "little")
    found = decoder([coil(100, "bool[256]")], 100, 256)(data)[0]
    assert found == [bool(number >> bit & 1) for bit in range(256)]


def test_an_array_of_bits_is_a_part_of_its_block() -> None:
    tags = [coil(32, "bool[2]"), coil(30), coil(45, "bool[3]"), coil(38, "bool[1]")]
    expected = [[True, False], True, [True, False, True], [True]]
    assert list(decoder(tags, 30, 24)(BITS)) == expected
    assert [value_of(tag, BITS, 30) for tag in tags] == expected


def test_registers_are_decoded_wherever_the_block_begins() -> None:
    tags = [
        register("flow", 12, "float32", order="CDAB"),
        register("name", 10, "string:4", encoding="latin-1"),
        register("low", 15),
    ]
    data = b"5\xb0C\0" + struct.pack(">f", 1.5)[2:] + struct.pack(">f", 1.5)[:2] + registers(0, 7)
    expected = [1.5, "5°C", 7]
    assert list(decoder(tags, 10, 6)(data)) == expected
    assert [value_of(tag, data, 10) for tag in tags] == expected


def test_registers_without_a_value_leave_the_others_as_they_are() -> None:
    tags = [register("a", 10), register("b", 11, "bcd16"), register("c", 12, order="BADC")]
    data = registers(1, 0xFA, 3)
    first, bad, last = decoder(tags, 10, 3)(data)
    assert (first, last) == (1, 0x300)
    assert isinstance(bad, Undecoded)
    assert bad.error == "digits 0x00FA are not bcd16, allowed: 0 to 9"
    assert value_of(tags[1], data, 10).error == bad.error
    assert value_of(tags[2], data, 10) == 0x300


@pytest.mark.parametrize(
    ("kind", "parts"),
    [
        ("uint32[6]", [(10, 4), (14, 4), (18, 4)]),
        ("uint16[6]", [(10, 5), (15, 1)]),
        ("float64[2]", [(10, 4), (14, 4)]),
        ("string:6[2]", [(10, 3), (13, 3)]),
        ("uint32[2]", [(10, 4)]),
        # A text that does not fit is cut, a number is not.
        ("string:12", [(10, 5), (15, 1)]),
    ],
)
def test_a_part_has_whole_elements(kind: str, parts: list[tuple[int, int]]) -> None:
    found = register("a", 10, kind).parts(5, 2000)
    assert [(part.start, len(part)) for part in found] == parts
    [whole] = register("a", 10, "uint64[2]").parts(3, 2000)
    assert whole == range(10, 18)
    assert coil(10, "bool[3]").parts(125, 2) == [range(10, 12), range(12, 13)]


@pytest.mark.parametrize(
    ("pieces", "data"),
    [
        ([(10, registers(1, 2)), (12, registers(3))], registers(1, 2, 3)),
        ([(12, registers(3)), (10, registers(1, 2))], registers(1, 2, 3)),
        ([(8, registers(7, 8, 1, 2, 3, 9, 9))], registers(1, 2, 3)),
        ([(8, registers(7, 8, 1, 2)), (11, registers(0, 3))], registers(1, 2, 3)),
        ([(8, registers(7, 8, 1)), (11, registers(2, 3))], None),
        ([(10, registers(1, 2))], None),
        ([(11, registers(2, 3))], None),
        ([], None),
    ],
    ids=repr,
)
def test_a_tag_is_assembled_from_whole_parts(
    pieces: list[tuple[int, bytes]], data: bytes | None
) -> None:
    tag, parts = register("a", 10, "uint16[3]"), [range(10, 12), range(12, 13)]
    counted = [(address, len(read) // 2, read) for address, read in pieces]
    assert assembled(tag, parts, counted) == data


def test_the_pieces_of_a_long_tag_are_looked_at_once_or_twice() -> None:
    looks = []

    class Piece(tuple[int, int, bytes]):
        __slots__ = ()

        def __iter__(self) -> Iterator[Any]:
            looks.append(self)
            return super().__iter__()

    tag = register("a", 10, "uint16[300]")
    pieces = [Piece((10 + at, 1, registers(at))) for at in range(300)]
    parts = tag.parts(1, 2000)
    assert assembled(tag, parts, pieces[100:] + pieces[:100]) == registers(*range(300))
    assert len(looks) < 3 * len(pieces)


def test_a_bit_that_is_off_is_not_one_that_is_missing() -> None:
    tag, parts = coil(10, "bool[3]"), [range(10, 12), range(12, 13)]
    assert assembled(tag, parts, [(9, 3, b"\x02"), (12, 1, b"\x00")]) == b"\x01"
    assert assembled(tag, parts, [(12, 1, b"\x01"), (9, 3, b"\x02")]) == b"\x05"
    assert assembled(tag, parts, [(9, 3, b"\xfa")]) is None, "a byte has more bits than were read"


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16, 17])
def test_bits_are_assembled_to_as_many_bytes_as_they_need(count: int) -> None:
    tag = coil(5, f"bool[{count}]")
    number = 0b1_0110_1001_1010_0110 & ((1 << count) - 1)
    pieces = [(5 + 8 * at, 8, bytes([number >> 8 * at & 0xFF])) for at in range((count + 7) // 8)]
    data = assembled(tag, tag.parts(125, 8), pieces)
    assert data == number.to_bytes((count + 7) // 8, "little")
    assert value_of(tag, data, 5) == [bool(number >> bit & 1) for bit in range(count)]


def test_a_block_has_the_tags_that_are_entirely_inside() -> None:
    tags = [
        register("late", 20, "uint32"),
        register("early", 10, "uint16[5]"),
        register("short", 10),
        Tag("other", "input_registers", 12),
    ]
    places = Places(tags)

    def inside(address: int, count: int) -> list[str]:
        return [tag.name for tag in places.inside("holding_registers", address, count)]

    assert inside(10, 12) == ["early", "short", "late"]
    assert inside(10, 11) == ["early", "short"]
    assert inside(10, 4) == ["short"]
    assert inside(11, 20) == ["late"]
    assert inside(21, 9) == []
    assert [tag.name for tag in places.inside("input_registers", 0, 100)] == ["other"]
    assert places.inside("coils", 0, 100) == []
