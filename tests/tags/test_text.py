"""Values of tags as text and for JSON, and what is parsed from text."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.tags import Tag
from holdfast.tags.text import plain, text_of, value_from
from holdfast.values import DoesNotFit

FLOAT32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


def tag(kind: str = "uint16", **more: Any) -> Tag:
    area = "coils" if kind.startswith("bool") else "holding_registers"
    settings: dict[str, Any] = {"area": area, "address": 0, "type": kind}
    return Tag("t", **(settings | more))


def float32(number: float) -> float:
    found: float = struct.unpack("f", struct.pack("f", number))[0]
    return found


@pytest.mark.parametrize(
    ("it", "raw", "text", "json_ready"),
    [
        (tag("float32"), float32(230.1), "230.1", 230.1),
        (tag("float32"), 230.0, "230", 230.0),
        (tag("float32", scale=0.001), float32(230.1), "0.2301", 0.2301),
        (tag("float32", offset=-273.15), float32(293.4), "20.25", 20.25),
        (tag("float32"), 1.5e30, "1.5e+30", 1.5e30),
        (tag("float64"), 0.1, "0.1", 0.1),
        (tag("float32"), math.inf, "inf", None),
        (tag("float32"), math.nan, "", None),
        (tag("int16", scale=0.1), 210, "21.0", 21.0),
        (tag("int16", scale=0.1), -1, "-0.1", -0.1),
        (tag("int16", scale=10), -1, "-10", -10),
        (tag("int16", scale=0.1, offset=0.25), 1, "0.35", 0.35),
        (tag("int16", scale=1 / 3), 1, str(1 / 3), 1 / 3),
        (tag("int16", scale=1e-9), 5, "5e-09", 5e-9),
        (tag("uint64"), 2**64 - 1, str(2**64 - 1), 2**64 - 1),
        (tag(states={0: "off", 2: "fault"}), 2, "fault", 2),
        (tag(states={0: "off"}), 7, "7", 7),
        (tag(scale=0.5, states={1: "on"}), 2, "on", 1.0),
        (tag(scale=0.5, states={1: "on"}), 1, "0.5", 0.5),
        (tag("int16", scale=0.000125), 8, "0.001000", 0.001),
        (tag("int16", scale=0.0001251), 10, "0.001251", 0.001251),
        (tag("float32", offset=-1), float32(1.1), "0.1", 0.1),
        (tag("float32", offset=1), float32(-0.9), "0.1", 0.1),
        (tag("float32", scale=2), float32(0.76377463), "1.52754926", 1.52754926),
        (tag("float32", scale=100), float32(1e38), "1e+40", 1e40),
        (tag("float32"), -math.inf, "-inf", None),
        (tag("float32", scale=0.1), math.inf, "inf", None),
        (tag("float64", scale=0.001), 230.1, "0.2301", 0.2301),
        (tag("float64", scale=0.001), 13436.4, "13.4364", 13.4364),
        (tag("float64", scale=10), 1e308, "inf", None),
        (tag("float64", scale=-10, offset=1), -math.inf, "inf", None),
        (
            tag("float64", scale=0.1),
            0.5442292252959519,
            "0.05442292252959519",
            0.05442292252959519,
        ),
        (tag("float16"), 0.0999755859375, "0.0999755859375", 0.0999755859375),
        (tag("float16"), 160.25, "160.25", 160.25),
        (tag("float16", scale=1000), 160.25, "160250", 160250.0),
        (tag("bool"), True, "true", True),
        (tag("bool"), False, "false", False),
        (tag("bool", states={0: "closed", 1: "open"}), True, "open", True),
        (tag("uint16", null=frozenset([65535])), 65535, "", None),
        (tag("string:8"), "P 1\n", "P 1\n", "P 1\n"),
        (tag("bytes:3"), b"\x01\x02\xff", "AQL/", "AQL/"),
        (tag("float32[2]"), [float32(0.1), math.nan], "[0.1,null]", [0.1, None]),
    ],
    ids=repr,
)
def test_a_value_has_the_digits_that_its_registers_have(
    it: Tag, raw: Any, text: str, json_ready: Any
) -> None:
    value = it.value(raw)
    assert text_of(it, value) == text
    made = plain(it, value)
    assert (made, type(made)) == (json_ready, type(json_ready))
    json.dumps(made, allow_nan=False)


def test_a_state_can_be_a_number_as_well() -> None:
    it = tag(states={0: "off", 2: "fault"})
    assert text_of(it, 2, states=False) == "2"


@given(FLOAT32, st.sampled_from([1, 0.1, 10, -0.001]), st.sampled_from([0, 20, -273.15]))
def test_the_text_of_a_float_is_read_back_as_the_same_float(
    number: float, scale: float, offset: float
) -> None:
    it = tag("float32", scale=scale, offset=offset)
    value = it.value(number)
    back = value_from(it, text_of(it, value))
    assert it.value(float32(it.raw(back))) == pytest.approx(value, rel=1e-7, abs=1e-4)
    if offset == 0:
        assert float32(it.raw(back)) == number


@given(st.integers(-32768, 32767), st.sampled_from([1, 0.1, 0.25, 100]))
def test_the_text_of_an_integer_is_read_back_as_the_same_registers(raw: int, scale: float) -> None:
    it = tag("int16", scale=scale)
    assert it.raw(value_from(it, text_of(it, it.value(raw)))) == raw


@pytest.mark.parametrize(
    ("scale", "offset", "raws"),
    [
        (100 / 27648, 0, range(27649)),
        (10 / 4095, -5, range(4096)),
        (-1 / 3, 273.15, range(-0x8000, 0x8000, 7)),
    ],
    ids=["percent of 27648", "volts of 4095", "a third"],
)
def test_every_value_of_a_scale_with_many_digits_can_be_written(
    scale: float, offset: float, raws: range
) -> None:
    it = tag("int16", scale=scale, offset=offset)
    texts = (text_of(it, it.value(raw)) for raw in raws)
    assert [it.raw(value_from(it, text)) for text in texts] == [*raws]


@pytest.mark.parametrize(
    ("it", "text", "value"),
    [
        (tag(scale=0.1), " 21.5 ", 21.5),
        (tag("uint64"), str(2**64 - 1), 2**64 - 1),
        (tag(), "0x1F", 31),
        (tag(states={1: "running"}), "running", "running"),
        (tag(states={1: "running"}), "1", 1),
        (tag("bool"), "ON", True),
        (tag("bit:3"), " Off ", False),
        (tag("bool[2]"), "[true, 0]", [True, 0]),
        (tag("uint16"), "+7", 7),
        (tag("int16"), "-7.5E1", -75),
        (tag("uint64"), "9007199254740993.0", 9007199254740993),
        (tag("uint64"), "1.8446744073709551615e19", 2**64 - 1),
        (tag("int64", scale=0.1), "-21.5", -21.5),
        (tag("float32"), ".5", 0.5),
        (tag("bit:3"), "0", False),
        (tag("bool", states={1: "open"}), "open", "open"),
        (tag("bool", states={1: "open"}), "Off", False),
        (tag("string:8"), " 1,5 ", " 1,5 "),
        (tag("bytes:3"), "AQL/", b"\x01\x02\xff"),
        (tag("uint16[2]"), "[1, 2]", [1, 2]),
        (tag("float32"), "-1.5e3", -1500.0),
    ],
    ids=repr,
)
def test_text_is_parsed_by_the_type_of_the_tag(it: Tag, text: str, value: Any) -> None:
    found = value_from(it, text)
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize(
    ("it", "text", "message"),
    [
        (tag("float32"), "21,5", "'21,5' has a decimal comma, .* as in 21.5"),
        (tag(scale=0.1), "21,5", "decimal comma"),
        (tag(), "0,125", "decimal comma"),
        (tag(), "1,000", "'1,000' is not a number"),
        (tag(), "much", "'much' is not a number"),
        (tag(), "", "'' is not a number"),
        (tag("float32"), "nan", "'nan' is not a number"),
        (tag("float32"), "0x10", "'0x10' is not a number"),
        (tag(scale=2), "0x10", "'0x10' is not a number"),
        (tag(offset=2), "0x10", "'0x10' is not a number"),
        (tag("float32"), "-,5e3", r"as in -\.5e3$"),
        (tag(), "1_000", "not a number"),
        (tag("bool"), "2", "'2' is not true, false, on, off, 1 or 0"),
        (
            tag("bool", states={0: "closed", 1: "open"}),
            "shut",
            "'shut' is not closed, open, true, false, on, off, 1 or 0",
        ),
        (
            tag("bool", states={0: "on", 1: "off"}),
            "OFF",
            "'OFF' is not on, off, true, false, 1 or 0",
        ),
        (tag("uint64", scale=0.001), "18446744073709551.616", "has too many digits"),
        (tag("int64", scale=0.1), "900719925474099.37", "has too many digits"),
        (tag("float64"), "1e-400", "'1e-400' is too small for float64, which would hold 0"),
        (tag("int16", scale=0.1), "-1e-400", "'-1e-400' is too small for int16"),
        (tag("float32[2]"), "[1, 1e-400]", "'1e-400' is too small"),
        (tag("uint16[2]"), "1 2", "JSON array"),
        (tag("bytes:3"), "zz!", "base64"),
    ],
    ids=repr,
)
def test_text_that_is_no_value_is_refused(it: Tag, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        value_from(it, text)


@pytest.mark.parametrize(
    ("it", "text", "value"),
    [
        (tag("float64"), "-1e-400", -0.0),
        (tag("int16", scale=0.1), "1e-400", 0.0),
        (tag("float32[2]"), "[1, 1e-400]", [1, 0.0]),
    ],
    ids=repr,
)
def test_a_measurement_may_become_zero(it: Tag, text: str, value: Any) -> None:
    assert repr(value_from(it, text, is_measurement=True)) == repr(value)


def test_a_measured_integer_has_an_exponent_that_a_decimal_has() -> None:
    with pytest.raises(ValueError, match="allowed: a JSON array"):
        value_from(tag("int16[1]"), "[1e-99999999999999999999]", is_measurement=True)


def test_a_scale_without_decimal_places_gives_none() -> None:
    assert text_of(tag("int16", scale=10, offset=5), 20.0) == "20"


def test_no_value_is_no_text() -> None:
    assert [text_of(tag("float32"), none) for none in (None, math.nan)] == ["", ""]


@pytest.mark.parametrize("text", ["-0", "-0.0"])
def test_the_sign_of_a_zero_that_is_typed_is_kept(text: str) -> None:
    assert math.copysign(1, value_from(tag("float32"), text)) == -1
    assert tag("int16").raw(value_from(tag("int16"), text)) == 0


def test_the_sign_of_zero_is_kept() -> None:
    assert text_of(tag("float32"), -0.0) == "-0"
    assert repr(plain(tag("float32"), -0.0)) == "-0.0"


def test_a_value_beyond_its_registers_has_all_its_digits() -> None:
    assert plain(tag("float32", scale=1e-300), 1.5e100) == 1.5e100


def test_an_unknown_state_is_refused_with_those_that_exist() -> None:
    it = tag(states={0: "off", 1: "running"})
    with pytest.raises(DoesNotFit, match="'stop' is no state, allowed: off, running"):
        it.raw(value_from(it, "stop"))
