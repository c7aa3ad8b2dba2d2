"""Floats with the digits that their type has."""

from __future__ import annotations

import struct

FLOATS = {"float16": "e", "float32": "f", "float64": "d"}
MAX_DIGITS = 17
LARGE = 1e16


def shortest(value: float, kind: str) -> str:
    """The shortest decimal that rounds to this float in its type: `0.1` for every float type."""
    if abs(value) < LARGE and value == int(value):
        return f"{value:.0f}"
    if kind in ("float16", "float32"):
        form = f">{FLOATS[kind]}"  # Without a mark, what is too large would be infinite.
        for digits in range(1, MAX_DIGITS):
            text = f"{value:.{digits}g}"
            try:
                is_same = struct.pack(form, float(text)) == struct.pack(form, value)
            except OverflowError:  # Rounded up, the largest values are outside the type.
                is_same = False
            if is_same:
                return text
    return repr(float(value))


def decimal_of(value: float, kind: str) -> str:
    """The decimal that a float of a type stands for: the shortest, of a `float16` all digits.

    The shortest decimals of a `float16` differ from it by up to 1 part in 4000: 160.25 is 160.2.
    """
    return shortest(value, "float64" if kind == "float16" else kind)
