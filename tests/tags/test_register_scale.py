"""A scale in a register: values are made with the scale of their own reply, or are bad."""

from __future__ import annotations

import math
from typing import Any, Final

import pytest

from holdfast import values
from holdfast.tags import Tag, TagError, TagList
from holdfast.tags.decoding import Places, Undecoded, decoder, value_of
from holdfast.tags.scale import Form, RegisterScale, linear_of
from holdfast.tags.text import plain, text_of
from holdfast.values import DoesNotFit

HR: Final = "holding_registers"


def by_name(form: Form = "exponent", **more: Any) -> TagList:
    source: dict[str, Any] = {"address": 12, "type": "int16", **more.pop("source", {})}
    made: dict[str, Any] = {"type": "int16", "scale": RegisterScale(form, "sf"), **more}
    return TagList([Tag("power", HR, 10, **made), Tag("sf", HR, **source)])


def value(tags: TagList, registers: list[int]) -> Any:
    """The value of `power`, whose block begins at 10; the error if it is bad."""
    power = tags["power"]
    data = b"".join(each.to_bytes(2) for each in registers)
    [found] = decoder([power], 10, len(registers))(data)
    alone = value_of(power, data, 10)
    if isinstance(found, Undecoded):
        assert isinstance(alone, Undecoded)
        assert alone.error == found.error
        return found.error
    assert power.value(alone) == power.value(found)
    return power.value(found)


@pytest.mark.parametrize(
    ("number", "exponent", "expected"),
    [
        (432, 1, 4320),
        (4320, 0, 4320),
        (43200, -1, 4320.0),
        (215, -1, 21.5),
        (3, -10, 3e-10),
        (3, 10, 30_000_000_000),
        (0, -3, 0.0),
    ],
)
def test_an_exponent_moves_the_point_exactly(number: int, exponent: int, expected: float) -> None:
    found = value(by_name(type="uint16"), [number, 0, exponent & 0xFFFF])
    assert (found, type(found)) == (expected, type(expected))


@pytest.mark.parametrize("exponent", [0x8000, 11, -11 & 0xFFFF, 0x7FFF])
def test_without_a_valid_exponent_a_number_is_bad(exponent: int) -> None:
    signed = exponent - 0x10000 if exponent & 0x8000 else exponent
    assert value(by_name(), [432, 0, exponent]) == (
        f"the scale in {HR} 12 is 10^{signed}, allowed: exponents from -10 to 10"
    )


def test_a_point_without_a_value_needs_no_scale() -> None:
    tags = by_name(null=frozenset([-32768]))
    assert value(tags, [0x8000, 0, 0x8000]) is None
    assert "10^-32768" in value(tags, [1, 0, 0x8000])


@pytest.mark.parametrize(
    ("source", "registers", "expected"),
    [
        ({"type": "uint16"}, [43, 0, 100], 4300),
        ({"type": "uint16", "scale": 0.01}, [43, 0, 50], 21.5),
        ({"type": "float32"}, [215, 0, *values.encode(0.1, "float32")], 21.5),
        ({"type": "float32", "scale": 0.5}, [100, 0, *values.encode(0.1, "float32")], 5),
        ({"type": "float32", "offset": 0.2}, [10, 0, *values.encode(0.1, "float32")], 3),
        ({"type": "float64", "scale": 0.7}, [10, 0, *values.encode(0.1, "float64")], 0.7),
        ({"type": "float16", "scale": 2}, [100, 0, *values.encode(0.1, "float16")], 19.9951171875),
        (
            {"type": "float32", "scale": 10, "offset": -1},
            [1, 0, *values.encode(0.1, "float32")],
            "is 0.0, allowed: a finite number other than 0",
        ),
        ({"type": "uint16"}, [43, 0, 0], "is 0, allowed: a finite number other than 0"),
        (
            {"type": "float32", "scale": 1 / 3},
            [3, 0, *values.encode(1.0, "float32")],
            0.9999999999999999,
        ),
        ({"type": "float32"}, [215, 0, 0x7FC0, 0], "has no value"),
        ({"type": "float32"}, [215, 0, 0x7F80, 0], "is inf, allowed: a finite number other"),
        ({"type": "uint16", "null": frozenset([7])}, [1, 0, 7], "has no value"),
        ({"type": "uint64"}, [1, 0, 32, 0, 0, 1], 2**53 + 1),
        ({"type": "uint16", "scale": 1e300}, [1, 0, 0xFFFF], 6.5535e304),
        ({"type": "float32"}, [0, 0, *values.encode(-0.1, "float32")], 0),
        ({"type": "uint64", "scale": 1e289}, [1, 0, *[0xFFFF] * 4], "is inf, allowed: a finite"),
        ({"type": "bcd16"}, [1, 0, 0xFFFF], "the scale: digits 0xFFFF are not bcd16"),
    ],
)
def test_a_factor_is_the_value_of_its_tag(
    source: dict[str, Any], registers: list[int], expected: Any
) -> None:
    found = value(by_name("factor", source=source), registers)
    assert expected in found if isinstance(expected, str) else found == expected


def test_floats_and_arrays_have_scales_too() -> None:
    floating = by_name(type="float32")
    registers = [*values.encode(0.1, "float32"), -1 & 0xFFFF]
    assert value(floating, registers) == 0.01
    assert repr(value(floating, [*registers[:2], 0])) == "0.1"
    assert plain(floating["power"], 0.01) == 0.01
    assert value(by_name(type="int16[2]", offset=5), [1, 2, 1]) == [15, 25]
    assert value(floating, [0x7F80, 0, 1]) == math.inf
    large = by_name(type="float64", source={"address": 14})
    assert value(large, [*values.encode(1e308, "float64"), 10]) == math.inf
    assert value(large, [*values.encode(-1e308, "float64"), 10]) == -math.inf
    assert text_of(floating["power"], 21.5) == "21.5"
    assert text_of(by_name()["power"], 432.0) == "432"


@pytest.mark.parametrize("offsets", [(2**63, 2.0**63), (2.0**63, 2**63)])
def test_equal_offsets_with_other_digits_make_other_values(offsets: tuple[float, float]) -> None:
    linear_of.cache_clear()
    found = [value(by_name(offset=offset), [1, 0, 0]) for offset in offsets]
    assert found == [2**63 + 1 if type(offset) is int else 2**63 + 193 for offset in offsets]


def test_states_that_a_scale_can_not_have_do_not_refuse_it() -> None:
    tag = by_name("factor", states={1: "on", 20: "high"}, writable=True)["power"]
    assert tag.with_scale(10).raw(20) == 2


def test_a_value_without_the_content_of_its_scale_is_refused() -> None:
    power = by_name(min=0)["power"]
    with pytest.raises(ValueError, match=f"the scale is in {HR} 12, which has to be read first"):
        power.value(432)
    with pytest.raises(DoesNotFit, match="has to be read first"):
        power.raw(4320)
    fixed = power.with_scale(1)
    assert (fixed.raw(4320), fixed.value(432), fixed.min) == (432, 4320, 0)
    with pytest.raises(DoesNotFit, match="steps of 10, or"):
        fixed.raw(4321)
    with pytest.raises(ValueError, match="is 10\\^-32768"):
        power.with_scale(-32768)


def test_a_block_has_tags_with_and_without_scales() -> None:
    tags = [by_name()["power"], Tag("other", HR, 11, "uint16")]
    scaled, other = decoder(tags, 10, 3)(b"\0\5\0\6\0\1")
    assert (tags[0].value(scaled), other) == (50, 6)


def test_each_tag_of_a_block_has_its_own_scale() -> None:
    places: list[tuple[Any, ...]] = [(12, "int16"), (11, "int16")]
    places += [(12, "int16", "BADC"), (12, "uint16")]
    tags = [
        Tag(f"t{at}", HR, 10, scale=RegisterScale("factor", source=Tag("", HR, *place)))
        for at, place in enumerate(places)
    ]
    found = decoder(tags, 10, 3)(b"\0\7\0\3\xff\xfe")
    assert [tag.value(raw) for tag, raw in zip(tags, found, strict=True)] == [
        *(-14, 21, -7 * 257, 7 * 0xFFFE)
    ]


def test_a_scale_is_at_most_as_far_away_as_one_request_reads() -> None:
    assert len(by_name(source={"address": 134})["power"].span) == 125


def test_values_of_an_array_may_have_none() -> None:
    tags = by_name(type="float32[2]", null=frozenset([0.1]), source={"address": 14})
    exponent = -1 & 0xFFFF
    full = values.encode([0.1, 215.0], "float32[2]")
    assert value(tags, [*full, exponent]) == [None, 21.5]
    assert value(tags, [*values.encode([0.2, 0.3], "float32[2]"), exponent]) == [0.02, 0.03]
    assert value(tags, [*values.encode([math.nan, math.inf], "float32[2]"), exponent]) == [
        None,
        math.inf,
    ]
    assert value(tags, [*values.encode([0.1, math.nan], "float32[2]"), 99]) == [None, None]


def test_registers_that_hold_no_number_have_no_value_with_any_scale() -> None:
    assert value(by_name(type="bcd16"), [0xFA, 0, 1]) == (
        "digits 0x00FA are not bcd16, allowed: 0 to 9"
    )


def test_a_block_has_a_tag_only_with_its_scale() -> None:
    tags = by_name()
    places = Places(tags)
    assert [each.name for each in places.inside(HR, 10, 3)] == ["power", "sf"]
    assert places.inside(HR, 10, 2) == []
    assert [each.name for each in places.inside(HR, 11, 2)] == ["sf"]
    before = TagList(
        [Tag("late", HR, 12, scale=RegisterScale("exponent", source=Tag("", HR, 2, "int16")))]
    )
    assert before["late"].span == range(2, 13)
    assert Places(before).inside(HR, 3, 20) == []


@pytest.mark.parametrize(
    ("source", "more", "message"),
    [
        ({}, {"scale": RegisterScale("exponent", "x")}, "the tag 'x' does not exist in this list"),
        ({"area": "input_registers"}, {}, "allowed: a register in holding_registers, as the value"),
        ({"type": "string:2"}, {}, "type string:2, allowed: a single number"),
        ({"type": "int16[2]"}, {}, "type int16[2], allowed: a single number"),
        ({"type": "float32"}, {}, "type float32, allowed: an integer exponent"),
        ({}, {"scale": RegisterScale("exponent", "power")}, "whose own scale is in a register"),
        ({"address": 135}, {}, "10 to 135 are 126 registers, one request reads at most 125"),
        ({}, {"type": "string:4"}, "scale is exponent from sf, allowed: only with numbers"),
    ],
)
def test_scales_that_one_request_cannot_read_are_refused(
    source: dict[str, Any], more: dict[str, Any], message: str
) -> None:
    place: dict[str, Any] = {"area": HR, "address": 12, "type": "int16", **source}
    made: dict[str, Any] = {"type": "int16", "scale": RegisterScale("exponent", "sf"), **more}
    with pytest.raises(TagError) as caught:
        TagList([Tag("power", HR, 10, **made), Tag("sf", **place)])
    assert caught.value.key == "scale"
    assert message in str(caught.value)


def test_a_scale_without_a_name_is_called_by_its_register() -> None:
    scale = RegisterScale("factor", source=Tag("", HR, 2))
    with pytest.raises(TagError, match=rf"^scale is factor from {HR} 2, allowed: only with num"):
        Tag("t", HR, 0, "string:2", scale=scale)


def test_a_list_takes_the_register_of_its_own_tag() -> None:
    first = by_name()
    moved = TagList([first["power"], Tag("sf", HR, 20, "int16")])
    assert moved["power"].span == range(10, 21)
    assert TagList([first["power"]])["power"].span == range(10, 13)
    assert moved != first
