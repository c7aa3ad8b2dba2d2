"""What a tag makes of registers, what it writes, and which tags can't be."""

from __future__ import annotations

import math
from array import array
from decimal import Decimal
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.simulation.capacity import nearest
from holdfast.tags import Tag, TagError, TagList
from holdfast.values import DoesNotFit, decode, encode


def tag(**more: Any) -> Tag:
    settings: dict[str, Any] = {"area": "holding_registers", "address": 0, "type": "int16"}
    return Tag("t", **(settings | more))


@pytest.mark.parametrize(
    ("raw", "scale", "offset", "value"),
    [
        (215, 0.1, 0, 21.5),
        (3, 0.1, 0, 0.3),
        (-7, 0.01, 20, 19.93),
        (12, 10, -5, 115),
        (1, 1 / 3, 0, 1 / 3),
        (1, 4, 0.5, 4.5),
        (1, 0.5, 4, 4.5),
        (0.5, 2, 0, 1.0),
        (math.inf, 2, 0, math.inf),
        (math.inf, -2, 5, -math.inf),
        (1e308, 10, 0, math.inf),
        (1e308, -10, 0, -math.inf),
        (-1e308, -10, 0, math.inf),
        (1e308, 1e300, 1e-300, math.inf),
        (1, 9e288, 0, 9 * 10**288),
        (1, 1.1e289, 0, 1.1e289),
        (1, 9e288, 1.7e308, 1.7e308),
        (-0.0, 1, 0, -0.0),
        (1000, 1e308, 0, math.inf),
        (-1000, 1e308, 0.5, -math.inf),
    ],
)
def test_a_value_is_the_scaled_number_without_a_rounding_error(
    raw: float, scale: float, offset: float, value: float
) -> None:
    kind = "float64" if isinstance(raw, float) else "int16"
    made = tag(type=kind, scale=scale, offset=offset).value(raw)
    assert (repr(made), type(made)) == (repr(value), type(value))


@given(
    st.integers(-32768, 32767),
    st.integers(-9999, 9999).filter(bool),
    st.integers(0, 4),
    st.integers(-9999, 9999),
)
def test_what_is_read_can_be_written_and_gives_the_same_registers(
    raw: int, scale: int, places: int, offset: int
) -> None:
    it = tag(scale=float(f"{scale}e-{places}"), offset=float(f"{offset}e-{places}"))
    assert it.raw(it.value(raw)) == raw


@pytest.mark.parametrize(
    ("value", "settings", "message"),
    [
        (
            21.53,
            {"scale": 0.1},
            "21.53 is between two values of the registers, allowed: steps of 0",
        ),
        (31, {"min": 5, "max": 30}, "31 is outside 5 to 30"),
        (4, {"min": 5}, "4 is outside the limits, allowed: at least 5$"),
        (
            1.5,
            {},
            "1.5 is between two values of the registers, allowed: steps of 1, or `round: nearest`",
        ),
        (49.99, {"scale": 100 / 27648}, "49.99 is between two values of the registers"),
        (math.nan, {"type": "float32"}, "nan is not a finite number"),
        (math.inf, {"scale": 2}, "inf is not a finite number"),
        (True, {}, "True is not a number"),
        ("on", {}, "'on' is not a number"),
        ("on", {"states": {0: "off", 1: "running"}}, "'on' is no state, allowed: off, running"),
        (31, {"max": 30}, "31 is outside the limits, allowed: up to 30$"),
        (Decimal("1.5"), {}, "1.5 is between two values of the registers"),
        (Decimal("NaN"), {}, "nan is not a finite number"),
        (Decimal("sNaN"), {}, "is not a number"),
        (Decimal("-1e999999999"), {}, "a Fraction is too large"),
        (Decimal("1e-999999999"), {}, "is between two values of the registers"),
        (Fraction(10**400), {}, "a Fraction is too large"),
        (Decimal("1e-330"), {"type": "float32"}, "^1E-330 is too small for float32, which would"),
        (Fraction(1, 10**330), {"type": "float64", "scale": 0.5}, "^a Fraction is too small for"),
        (Decimal("6." + "1" * 5000), {"max": 5}, "^a Decimal is outside the limits, allowed: up"),
        (Fraction(10**5000 + 1, 10**5000), {}, "^a Fraction is between two values"),
        (Decimal("5." + "0" * 5000 + "1"), {"max": 5}, "^a Decimal is outside the limits"),
        (10**400, {}, "an integer of 1329 bits is too large"),
        (-(10**400), {"type": "float64"}, "an integer of 1329 bits is too large"),
        (1e308, {"type": "float32", "scale": 0.001}, r"1e\+308 does not fit float32$"),
        (0.7, {"type": "bcd16"}, "0.7 is between two values of the registers"),
        ([1, None], {"type": "uint16[2]"}, "None is not a number"),
        (3276.7, {"scale": 0.1, "null": frozenset([32767])}, r"3276\.7 stands for no value"),
        (3276.74, {"scale": 0.1, "round": "nearest", "null": frozenset([32767])}, "for no value"),
        (-99.9, {"type": "float32", "null": frozenset([-99.9])}, r"-99\.9 stands for no value"),
        ("on", {"states": {7: "on"}, "null": frozenset([7])}, "7 stands for no value"),
        ([1, 7], {"type": "uint16[2]", "null": frozenset([7])}, "7 stands for no value"),
    ],
)
def test_a_value_that_does_not_fit_is_refused(
    value: Any, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(DoesNotFit, match=message):
        tag(**settings).raw(value)


@pytest.mark.parametrize(
    ("value", "settings", "number"),
    [
        (Decimal("21.5"), {"scale": 0.1, "max": 21.5}, 215),
        (Decimal("0.1"), {"scale": 0.1, "min": 0.1}, 1),
        (Decimal("1E+2"), {}, 100),
        (Decimal("0E-999999999"), {}, 0),
        (Fraction(43, 2), {"scale": 0.1}, 215),
        ([Decimal(1), 2], {"type": "uint16[2]"}, [1, 2]),
        (Decimal("0.1"), {"type": "float32"}, 0.1),
        (Decimal("0." + "3" * 5000), {"type": "float64"}, 1 / 3),
        (Fraction(10**5000 + 1, 3 * 10**5000), {"type": "float64"}, 1 / 3),
        (Decimal(2**64 + 1) / 2**12, {"type": "float64", "scale": 0.5}, 2.0**53),
    ],
)
def test_decimals_and_fractions_are_numbers(
    value: Any, settings: dict[str, Any], number: Any
) -> None:
    raw = tag(**settings).raw(value)
    assert raw == number
    assert type(raw) is type(number)


@pytest.mark.parametrize(
    ("value", "settings", "number"),
    [
        (21.53, {"scale": 0.1}, 215),
        (-21.57, {"scale": 0.1}, -216),
        (21.53, {"scale": -0.1, "offset": 20}, -15),
        (2.5, {}, 2),
        (3.5, {}, 4),
        ([0.2, 0.8], {"type": "int16[2]"}, [0, 1]),
        ((0.2, 0.8), {"type": "int16[2]"}, [0, 1]),
        (array("d", [0.2, 0.8]), {"type": "int16[2]"}, [0, 1]),
        (21.5, {"type": "float32"}, 21.5),
        (-1e-50, {"type": "float32"}, 0),
    ],
)
def test_a_value_between_two_steps_becomes_the_nearest_if_the_tag_or_the_writer_says_so(
    value: Any, settings: dict[str, Any], number: Any
) -> None:
    assert tag(**settings).raw(value, default_round="nearest") == number
    if not tag(**settings).is_stepped:
        return
    assert tag(**settings, round="nearest").raw(value) == number
    with pytest.raises(DoesNotFit, match="between two values"):
        tag(**settings, round="exact").raw(value, default_round="nearest")


def test_a_float_that_would_be_0_is_refused_unless_it_is_a_measurement() -> None:
    assert encode(tag(type="float32").raw(1e-50, default_round="nearest"), "float32") == [0, 0]
    with pytest.raises(DoesNotFit, match="too small for float32"):
        encode(tag(type="float32").raw(1e-50), "float32")
    with pytest.raises(DoesNotFit, match="too small for float64"):
        tag(type="float64", scale=1e300).raw(1e-300)
    assert tag(type="float16", offset=0.3).raw(0.1 + 0.2) == 0


def test_limits_hold_for_the_rounded_value() -> None:
    it = tag(scale=0.5, min=0.3, max=20.3, round="nearest")
    assert (it.raw(0.5), it.raw(20.1)) == (1, 40)
    with pytest.raises(DoesNotFit, match=r"20.3 is 20.5 in steps of 0.5, outside 0.3 to 20.3"):
        it.raw(20.3)


@pytest.mark.parametrize(
    ("value", "settings", "message"),
    [
        (
            1001.3,
            {"max": 1001.3},
            r"^1001\.3 is 1001\.5 in float16, outside the limits",
        ),
        (
            1000.7,
            {"min": 1000.7},
            r"^1000\.7 is 1000\.5 in float16, outside the limits",
        ),
        (
            160.22,
            {"max": 160.22},
            r"160\.22 is 160\.25 in float16, outside the limits",
        ),
        (
            0.1,
            {"min": 0.1},
            r"0\.1 is 0\.0999755859375 in float16, outside the limits",
        ),
        (2049, {"min": 2049, "max": 3000}, "2049 is 2048.0 in float16, outside 2049 to 3000"),
        (
            100.13,
            {"max": 100.13, "scale": 0.1},
            "100.13 is 100.15 in float16, outside the limits",
        ),
        (
            5.3,
            {"max": 5.3, "offset": -1000},
            "5.3 is 5.5 in float16, outside the limits",
        ),
        ([1, 1001.3], {"max": 1001.3, "type": "float16[2]"}, "1001.3 is 1001.5 in float16, "),
    ],
)
def test_limits_hold_for_what_a_float16_makes_of_a_value(
    value: Any, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(DoesNotFit, match=message):
        tag(**({"type": "float16"} | settings)).raw(value)


@given(
    st.sampled_from(["float32", "float64"]),
    st.integers(-999, 999),
    st.integers(0, 4),
)
def test_a_limit_in_decimal_may_be_written_itself(kind: str, digits: int, places: int) -> None:
    limit = float(f"{digits}e-{places}")
    assert tag(type=kind, min=limit, max=limit).raw(limit) == limit


@pytest.mark.parametrize("limit", [math.pi, 16777219, 0.123456789, 1e-30, 1 / 3])
@pytest.mark.parametrize(("scale", "offset"), [(1, 0), (1.8, 32), (0.6, 0), (1, -273.15)])
@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_a_limit_that_floats_do_not_have_may_be_written_itself(
    limit: float, scale: float, offset: float, kind: str
) -> None:
    it = tag(type=kind, min=limit, max=limit, scale=scale, offset=offset)
    held = decode(encode(it.raw(limit), kind), kind)
    assert it.value(held) == pytest.approx(limit, rel=1e-7, abs=2**-24 * abs(offset))


@pytest.mark.parametrize(
    ("kind", "value"),
    [("float16", 1e6), ("float16", 70000), ("float32", 1e39), ("float32", -(10**39))],
)
def test_a_float_that_does_not_fit_is_left_to_its_codec(kind: str, value: float) -> None:
    it = tag(type=kind, null=[7])
    assert it.raw(65504) == 65504
    assert it.raw(value) == value
    with pytest.raises(DoesNotFit, match=rf"is outside -.* of {kind}"):
        encode(it.raw(value), kind)


def test_the_limits_themselves_may_be_written() -> None:
    it = tag(min=5, max=30)
    assert (it.raw(5), it.raw(30)) == (5, 30)
    assert tag(min=5, max=5).raw(5) == 5


def test_a_number_with_a_scale_is_rounded_to_a_float_once() -> None:
    it = tag(type="float32", scale=2)
    value, held = 2 * (2**60 + 2**36 + 1), 2.0**60 + 2.0**37
    assert it.raw(value) == decode(encode(it.raw(value), "float32"), "float32") == held
    assert nearest(it, value) == held


def test_a_state_is_never_rounded() -> None:
    with pytest.raises(DoesNotFit, match="between two values"):
        tag(states={0: "off", 1: "on"}).raw(0.7, default_round="nearest")


def test_states_have_names_both_ways() -> None:
    it = tag(states={0: "off", 1: "running"})
    assert [it.state(it.value(raw)) for raw in (0, 1, 2)] == ["off", "running", None]
    assert (it.raw("running"), it.raw(1)) == (1, 1)
    assert (it.state(None), it.state("1"), it.state([1])) == (None, None, None)
    half = tag(scale=0.5, states={0: "off", 1: "running"})
    assert [half.state(half.value(raw)) for raw in (0, 1, 2)] == ["off", None, "running"]
    assert half.raw("running") == 2


def test_markers_and_nan_are_no_values() -> None:
    it = tag(null=frozenset([-1]), scale=0.1)
    assert [it.value(raw) for raw in (-1, 0, 5)] == [None, 0.0, 0.5]
    assert tag(type="float32").value(math.nan) is None
    assert tag(type="int16[3]", null=frozenset([7])).value([7, 8, 9]) == [None, 8, 9]


def test_a_marker_is_what_the_registers_hold() -> None:
    it = tag(type="float32", null=frozenset([0.1]))
    held = decode(encode(0.1, "float32"), "float32")
    assert it.null == {held}
    text = tag(type="string:4", encoding="latin-1", null=frozenset(["°"]))
    assert (text.value("°"), text.value("A")) == (None, "A")
    assert (it.value(held), it.value(0.1)) == (None, 0.1)


@pytest.mark.parametrize(
    ("settings", "key", "message"),
    [
        ({"area": "registers"}, "area", "area is 'registers', allowed: coils, "),
        ({"address": 65536}, "address", "address is 65536, allowed: 0 to 65535"),
        ({"address": True}, "address", "address is True"),
        ({"address": -1}, "address", "address is -1, allowed: 0 to 65535"),
        ({"address": 65535, "type": "float32"}, "address", "ends at 65536, allowed: up to 65535"),
        ({"type": "flaot32"}, "type", "type 'flaot32' is unknown"),
        ({"order": "ABDC"}, "order", "order"),
        ({"area": "coils", "type": "int16"}, "type", "allowed in coils: bool"),
        ({"type": "string:4", "encoding": "klingon"}, "encoding", "klingon"),
        ({"scale": 0}, "scale", "scale is 0, allowed: any other number"),
        ({"offset": math.inf}, "offset", "offset is inf, allowed: a finite number"),
        ({"scale": 10**400}, "scale", "allowed: a finite number"),
        ({"deadband": math.inf}, "deadband", "deadband is inf, allowed: a finite number"),
        ({"deadband": 10**400}, "deadband", "allowed: a finite number"),
        ({"min": math.nan, "max": 1}, "min", "min is nan, allowed: a finite number"),
        ({"min": 0, "max": math.nan}, "max", "max is nan, allowed: a finite number"),
        ({"max": math.inf}, "max", "max is inf, allowed: a finite number"),
        ({"min": "1"}, "min", "min is '1', allowed: a finite number, int or float"),
        ({"scale": "0.1"}, "scale", "scale is '0.1', allowed: a finite number, int or float"),
        ({"scale": None}, "scale", "scale is None, allowed: a finite number, int or float"),
        ({"scale": True}, "scale", "scale is True, allowed: a finite number, int or float"),
        ({"offset": [1]}, "offset", "offset is a list, allowed: a finite number, int or float"),
        ({"type": "string:4", "scale": 2}, "scale", "scale is 2, allowed: only with numbers"),
        ({"type": "bool", "deadband": 1}, "deadband", "only with numbers"),
        ({"deadband": -1}, "deadband", "allowed: a finite number from 0"),
        ({"min": 2, "max": 1}, "max", "max is 1, allowed: at least min, 2"),
        ({"type": "float32", "states": {0: "off"}}, "states", "states of float32"),
        ({"type": "string:4", "states": {0: "off"}}, "states", "states of string:4"),
        ({"type": "bytes:4", "states": {0: "off"}}, "states", "states of bytes:4"),
        ({"type": "float32", "round": "nearest"}, "round", "only with integers without states"),
        ({"states": {0: "off"}, "round": "nearest"}, "round", "round is nearest, allowed: only"),
        ({"type": "string:4", "round": "exact"}, "round", "only with integers without states"),
        ({"states": {0: "on", 1: "off", 2: "off"}}, "states", "two states have the name 'off'"),
        (
            {"type": "int16", "states": {0: "ok", 65535: "fault"}},
            "states",
            "65535 is outside -32768 to 32767 of int16",
        ),
        ({"type": "bcd16", "states": {-1: "off"}}, "states", "-1 is outside 0 to 9999 of bcd16"),
        ({"type": "uint16", "states": {-1: "off"}}, "states", "-1 is outside 0 to 65535 of uint16"),
        (
            {"type": "bcd16", "offset": 10, "states": {9: "off"}},
            "states",
            "9, -1 in the registers, is outside 0",
        ),
        ({"type": "bit:3", "states": {2: "on"}}, "states", "2 is outside 0 to 1 of bit:3"),
        ({"scale": 10, "states": {5: "on"}}, "states", "5 is between two values of the registers"),
        ({"area": "input_registers", "writable": True}, "writable", "input_registers can't be"),
        ({"type": "bit:3[2]", "writable": True}, "writable", "only one bit can"),
        ({"type": "uint16[124]", "writable": True}, "writable", "124 registers, one request"),
        (
            {"area": "coils", "type": "bool[1969]", "writable": True},
            "writable",
            "bool[1969] has 1969 coils, one request writes at most 1968",
        ),
        ({"states": {"1": "on"}}, "states", "found the state '1', allowed: an integer"),
        ({"states": {1.0: "on"}}, "states", "found the state 1.0, allowed: an integer"),
        ({"states": ["off", "on"]}, "states", "states is a list, allowed: names by number"),
        ({"null": 5}, "null", "null is 5, allowed: a set, as in "),
        ({"type": "string:4", "null": "none"}, "null", "null is 'none', allowed: a set"),
        ({"null": frozenset(["x"])}, "null", "x"),
        ({"null": frozenset(["nan"])}, "null", "'nan' is not an integer"),
        ({"type": "bytes:4", "null": frozenset([1])}, "null", "not supported for bytes:4"),
    ],
)
def test_a_wrong_tag_names_the_wrong_key(settings: dict[str, Any], key: str, message: str) -> None:
    with pytest.raises(TagError, match=message.replace("[", r"\[")) as caught:
        tag(**settings)
    assert caught.value.key == key


def test_a_tag_without_a_type_is_a_bit_or_a_register() -> None:
    assert (Tag("a", "coils", 0).type, Tag("b", "input_registers", 0).type) == ("bool", "uint16")


def test_a_tag_has_nothing_that_it_was_not_given() -> None:
    made = Tag("t", "holding_registers", 0)
    assert (made.unit, made.description, made.encoding, made.round) == ("", "", None, None)
    assert (made.writable, made.states, made.null, made.deadband) == (False, {}, frozenset(), 0)
    assert (made.min, made.max, made.value(7)) == (None, None, 7)


def test_a_bit_has_no_order_of_bytes() -> None:
    made = tag(area="coils", type="bool[3]", order="DCBA")
    assert made == tag(area="coils", type="bool[3]")


def test_the_address_may_be_an_integer_of_any_library() -> None:
    class Integer:
        def __index__(self) -> int:
            return 7

    made = tag(address=Integer())
    assert (made.address, type(made.address)) == (7, int)


def test_the_largest_tags_that_one_request_writes_are_writable() -> None:
    assert tag(type="uint16[123]", writable=True).writable
    assert tag(area="coils", type="bool[1968]", writable=True).writable
    assert tag(type="bit:3", writable=True).writable


def test_tags_are_equal_and_found_by_their_settings() -> None:
    settings: dict[str, Any] = {"scale": 0.1, "states": {1: "on"}, "null": frozenset([7])}
    assert tag(**settings) == tag(**settings) != tag(**{**settings, "scale": 0.2})
    assert {tag(**settings): 5}[tag(**settings)] == 5
    assert TagList([tag()]) == TagList([tag()]) != [tag()]


def test_equal_numbers_with_other_digits_make_other_tags() -> None:
    """As they are written, 2**63 ends with 808, and 2.0**63 with 6000."""
    written = tag(offset=2**63), tag(offset=2.0**63)
    assert written[0] != written[1]
    assert TagList(written[:1]) != TagList(written[1:])
    assert tag(scale=2) == tag(scale=2.0)


def test_tags_that_have_nan_as_marker_are_equal() -> None:
    assert tag(type="float32", null={"nan"}) == tag(type="float32", null={float("nan")})


def test_the_text_of_a_tag_makes_the_tag() -> None:
    made = TagList([tag(scale=0.1, offset=5), tag_of("sf")])
    text = repr(made)
    assert eval(text, {"Tag": Tag, "TagList": TagList}) == made
    assert text.count("address=0") == 2


def tag_of(name: str) -> Tag:
    return Tag(name, "input_registers", 0, "float32", null=frozenset([1.5]))


def test_a_tag_may_end_with_its_area() -> None:
    assert tag(address=65535).end == tag(address=65534, type="float32").end == 65536


def test_a_list_has_each_name_once() -> None:
    with pytest.raises(TagError, match="two tags have the name 't'") as caught:
        TagList([tag(), tag(address=1)])
    assert caught.value.key == "name"
    with pytest.raises(TypeError, match=r"^\('a', 'coils', 0\) is not a tag, allowed"):
        TagList([("a", "coils", 0)])  # type: ignore[list-item]


def test_a_list_is_a_table_of_its_tags() -> None:
    tags = TagList([tag(), tag_of("sf")])
    assert ("sf" in tags, "x" in tags, len(tags)) == (True, False, 2)
    assert [each.name for each in tags] == ["t", "sf"]
    assert tags["sf"] == tag_of("sf")
    assert len(TagList()) == 0


def test_nan_as_marker_is_the_value_of_a_float() -> None:
    [marker] = tag(type="float32", null=frozenset(["nan"])).null
    assert isinstance(marker, float)
    assert math.isnan(marker)


def test_text_bits_and_floats_are_written_as_they_are() -> None:
    assert tag(type="string:4").raw("AB") == "AB"
    assert repr(tag(type="float32").raw(-0.0)) == "-0.0"
    assert tag(area="coils", type="bool").raw(True) is True
