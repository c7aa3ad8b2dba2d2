"""Recognises a date and time in decimal digits (BCD), as clocks of devices have them.

Fields in their ranges prove little: the words 2307, 2321 and 2325, three voltages in tenths, are
15 September 2015, 09:03:09. So a clock is described like any other value, by what a date and time
of these years costs. That is less than its registers cost as numbers only if they advance as a
clock does, or show the present.
"""

from __future__ import annotations

import itertools
import math
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from holdfast.discovery.plausibility import CLOCK_ERROR_S

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

MAX_REGISTERS = max(map(len, FORMS)) // 2

PLAIN = 10
"""Fields below are the same number in decimal digits and in binary: they prove nothing."""


RARE = 3.0
"""How rare clocks are among decimal numbers, in bits, with the choice of their form."""

STEP_MAX_S = 3_600
"""The most seconds by which a clock advances between two reads."""

UNPROVEN = 12.0
"""How rare a clock is that neither advances nor shows the present, in bits."""

SAME = 0.5
ADVANCE = 1.5
SET = 20.0
"""The bits of a later read: with the same time, with one that advances, and with another time."""


def description(contents: Sequence[Sequence[int]], now: float | None) -> tuple[float, int] | None:
    """The bits and the registers of a clock at the first registers of each read; `None` if they are
    none. `now` is the time of the last read, in seconds of Unix time.
    """
    form = _form(contents[-1])
    if form is None:
        return None
    known = [time for each in contents if (time := _time(each, form)) is not None]
    if len(known) < len(contents):
        return None
    resolution = 1 if "s" in form else 60
    bits = RARE + math.log2((RANGES["Y"].stop - RANGES["Y"].start) * 365 * 86_400 / resolution)
    # In any time zone.
    if now is not None and abs(known[-1].replace(tzinfo=UTC).timestamp() - now) <= CLOCK_ERROR_S:
        bits = RARE + math.log2(2 * CLOCK_ERROR_S / resolution)
    elif known[0] == known[-1]:
        bits += UNPROVEN
    for before, after in itertools.pairwise(known):
        step = (after - before).total_seconds()
        bits += SAME if step == 0 else ADVANCE if 0 < step <= STEP_MAX_S else SET
    return bits, len(form) // 2


def _form(registers: Sequence[int]) -> str | None:
    """The form of a date and time; `None` if the registers are none."""
    digits = [_decimal(byte) for each in registers[:MAX_REGISTERS] for byte in divmod(each, 256)]
    fitting = (form for form in FORMS if len(form) <= len(digits))
    return next((form for form in fitting if _belong(digits[: len(form)], form)), None)


def _belong(digits: Sequence[int | None], form: str) -> bool:
    """Whether all digits are in the ranges of their fields, and enough of them prove something."""
    for digit, name in zip(digits, form, strict=True):
        if digit is None or digit not in RANGES[name]:
            return False
    return sum(digit is not None and digit >= PLAIN for digit in digits) > len(digits) // 4


def _time(registers: Sequence[int], form: str) -> datetime | None:
    """The time that registers show; `None` if there is no such day or field."""
    digits = [_decimal(byte) for each in registers[: len(form) // 2] for byte in divmod(each, 256)]
    if not _belong(digits, form):
        return None
    found = {name: digit or 0 for name, digit in zip(form, digits, strict=True)}
    try:
        day = datetime(2000 + found["Y"], found["M"], found["D"])
    except ValueError:
        return None
    return day + timedelta(hours=found["h"], minutes=found["m"], seconds=found.get("s", 0))


def _decimal(byte: int) -> int | None:
    """The number of two decimal digits, or `None`."""
    tens, ones = divmod(byte, 16)
    return 10 * tens + ones if tens < 10 and ones < 10 else None
