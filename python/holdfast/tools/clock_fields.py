"""Recognises a date and time in decimal digits (BCD), as clocks of devices have them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

RANGES = {
    "C": range(20, 21),
    "Y": range(15, 40),
    "M": range(1, 13),
    "D": range(1, 32),
    "h": range(24),
    "m": range(60),
    "s": range(60),
    "0": range(1),
}
"""The allowed values of each field; C is the century."""

FORMS = ("CYMDhms0", "CYMDhm", "YMDhms", "smhDMY", "0Y0M0D0h0m0s", "0s0m0h0D0M0Y", "CY0M0D0h0m0s")
"""The fields of the bytes, the longest form first for each beginning."""

PLAIN = 10
"""Fields below are the same number in decimal digits and in binary: they prove nothing."""


def length(registers: Sequence[int]) -> int:
    """How many registers from the first on are a date and time; 0 if they are none."""
    for form in FORMS:
        size = len(form) // 2
        if len(registers) < size:
            continue
        digits = [_decimal(byte) for each in registers[:size] for byte in divmod(each, 256)]
        fields = zip(form, digits, strict=True)
        if all(digit is not None and digit in RANGES[name] for name, digit in fields):
            proven = sum(digit is not None and digit >= PLAIN for digit in digits)
            if proven > len(digits) // 4:
                return size
    return 0


def _decimal(byte: int) -> int | None:
    """The number of two decimal digits, or `None`."""
    tens, ones = divmod(byte, 16)
    return 10 * tens + ones if tens < 10 and ones < 10 else None
