"""Floats as text: no more digits than their type has."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.values.digits import decimal_of, shortest


def float32(number: float) -> float:
    found: float = struct.unpack("f", struct.pack("f", number))[0]
    return found


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (0.1, "float64", "0.1"),
        (0.1, "", "0.1"),
        (float32(0.1), "float32", "0.1"),
        (float32(0.1), "float64", "0.10000000149011612"),
        (float32(-107216.876), "float32", "-107216.875"),
        (0.0999755859375, "float16", "0.1"),
        (2.0**-23, "float16", "1e-07"),
        (16777216.0, "float32", "16777216"),
        (65504.0, "float16", "65504"),
        (1 / 3, "float64", "0.3333333333333333"),
        (100000.0, "float64", "100000"),
        (8e15, "float64", "8000000000000000"),
        (1e16, "float64", "1e+16"),
        (1.5e-7, "float64", "1.5e-07"),
        (1e30, "float64", "1e+30"),
        (float32(3.4028234663852886e38), "float32", "3.4028235e+38"),
        (1e300, "float32", "1e+300"),
        (1.5e300, "float32", "1.5e+300"),
        (1.5e300, "float16", "1.5e+300"),
        (-0.0, "float32", "-0"),
        (math.inf, "float32", "inf"),
        (math.nan, "float32", "nan"),
        (struct.unpack(">f", b"\xff\xc0\0\1")[0], "float32", "nan"),
    ],
)
def test_a_float_has_the_digits_that_its_type_needs(value: float, kind: str, text: str) -> None:
    assert shortest(value, kind) == text


@given(st.floats(width=32, allow_nan=False))
def test_a_short_float_is_the_same_float(value: float) -> None:
    assert struct.pack("f", float(shortest(value, "float32"))) == struct.pack("f", value)


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (160.25, "float16", "160.25"),
        (0.0999755859375, "float16", "0.0999755859375"),
        (2049.0, "float16", "2049"),
        (float32(0.1), "float32", "0.1"),
        (0.1, "float64", "0.1"),
    ],
)
def test_a_float16_stands_for_all_of_its_digits(value: float, kind: str, text: str) -> None:
    assert decimal_of(value, kind) == text
