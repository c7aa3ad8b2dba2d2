"""Lines that InfluxDB and others read, by a parser that knows only the specification."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.config.values.scalars import is_measurement
from holdfast.outputs.line_protocol import has_field, lines
from holdfast.tags.scale import RegisterScale
from support.line_protocol import parsed
from support.readings import TIME, reading, tag

AT = 1_700_000_000_250_000_000


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (21.5, "21.5"),
        (7, "7i"),
        (2**63 - 1, "9223372036854775807i"),
        (2**63, "9.223372036854776e+18"),
        (True, "true"),
        ('a "b" \\ c', r'"a \"b\" \\ c"'),
        ("1\n2\r3\f4\0", '"1\\\\n2\\\\r3\\\\f4\0"'),
        (b"\0\xff", '"AP8="'),
    ],
)
def test_a_value_is_written_in_its_kind(value: Any, written: str) -> None:
    assert (
        lines([reading(value)], "modbus", {}) == f"modbus,device=pump t={written} {AT}\n".encode()
    )


def test_a_text_can_not_begin_a_line() -> None:
    forged = "v1\nmodbus,device=boiler power=99\nx"
    [point] = parsed(lines([reading(forged), reading(7, tag=tag("n"))], "modbus", {}))
    assert point.tags == {"device": "pump"}
    assert point.fields == {"t": r"v1\nmodbus,device=boiler power=99\nx", "n": 7}


def test_the_values_of_one_time_share_a_line() -> None:
    readings = [
        reading(1, tag=tag("a")),
        reading(None, tag=tag("b")),
        reading([1.5, None], tag=tag("c")),
        reading(2, TIME + 1, tag=tag("a")),
        reading(3, tag=tag("a"), device="fan"),
        reading(None, tag=tag("a"), device="off"),
        reading(math.inf, tag=tag("d")),
    ]
    assert lines(readings, "modbus", {"site": "north"}).decode().splitlines() == [
        f"modbus,device=pump,site=north a=1i,c[0]=1.5 {AT}",
        f"modbus,device=pump,site=north a=2i {AT + 10**9}",
        f"modbus,device=fan,site=north a=3i {AT}",
    ]


@pytest.mark.parametrize(
    "value", [0, False, "", b"", 1e308, [None, 1], None, math.nan, -math.inf, [], [None, math.inf]]
)
def test_what_has_no_field_has_no_line(value: Any) -> None:
    assert has_field(value) is bool(lines([reading(value)], "m", {}))


def test_floats_have_their_digits_and_wide_integers_are_floats() -> None:
    readings = [
        reading(230.10000610351562, tag=tag("v", type="float32")),
        reading(7, tag=tag("n", type="uint64")),
        reading(None, tag=tag("m", type="uint64")),
        reading([1, 2**64 - 1, None], tag=tag("a", type="uint64[3]")),
        reading(7, tag=tag("w", type="int64", scale=10)),
        reading(7, tag=tag("o", type="int64", offset=-1)),
        reading(7, tag=tag("i", type="int64", scale=-1, offset=-1)),
        reading(7, tag=tag("k", type="uint32", scale=1000)),
        reading(7, tag=tag("p", type="int16", scale=RegisterScale("exponent", "sf"))),
        # It waited since its tag had another type.
        reading("on", tag=tag("s", type="uint64")),
    ]
    fields = 'v=230.1,n=7.0,a[0]=1.0,a[1]=1.8446744073709552e+19,w=7.0,o=7.0,i=7i,k=7i,p=7.0,s="on"'
    expected = f"modbus,device=pump {fields} {AT}\n"
    assert lines(readings, "modbus", {}).decode() == expected


def test_equal_offsets_with_other_digits_make_integers_or_floats() -> None:
    """As it is written, -2.0**63 ends with 6000, which is less than all integers."""
    offsets = {"n": -(2**63), "w": -(2.0**63)}
    readings = [
        reading(7, tag=tag(name, type="uint16", offset=each)) for name, each in offsets.items()
    ]
    assert lines(readings, "m", {}).decode() == f"m,device=pump n=7i,w=7.0 {AT}\n"


NAMES = st.text(st.characters(codec="utf-8")).filter(is_measurement)


@given(NAMES, NAMES, st.text(st.characters(codec="utf-8")), st.floats(allow_nan=False))
def test_whatever_names_and_texts_are_a_parser_finds_them(
    measurement: str, site: str, text: str, number: float
) -> None:
    readings = [reading(text, tag=tag("a"), device="x y"), reading(7, tag=tag("b"), device="x y")]
    [point] = parsed(lines(readings, measurement, {"site": site}))
    assert point.measurement == measurement
    assert point.tags == {"device": "x y", "site": site}
    stored = text.replace("\n", r"\n").replace("\r", r"\r").replace("\f", r"\f")
    assert point.fields == {"a": stored, "b": 7}
    assert point.time == AT
    found = parsed(lines([reading(number)], "m", {}))
    assert [each.fields for each in found] == ([{"t": number}] if math.isfinite(number) else [])
