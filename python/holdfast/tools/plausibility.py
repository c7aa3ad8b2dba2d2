"""How plausible a sequence of values is for a type, in bits: the length of a short description.

A usual value has a short description: small integers, round numbers, floats of usual magnitude or
with few digits, text. A later value is described by its change. Registers that are read with a
wrong type or order have long descriptions, so descriptions of the same registers can be compared.
"""

from __future__ import annotations

import itertools
import math
import struct
from typing import TYPE_CHECKING, Any

from holdfast.values.digits import FLOATS, shortest

if TYPE_CHECKING:
    from collections.abc import Sequence

MANTISSAS = {"float16": 10, "float32": 23, "float64": 52}

BITS_A_DIGIT = math.log2(10)
SAME = 0.5
ANEW = 3.0
"""Bits for a value that equals the one before, and for one that has nothing to do with it."""

SPREAD = {16: 3.5, 32: 4.5, 64: 5.5}
"""Bits for the size of an integer, by its width."""

USUAL_MAX = {16: 10_000, 32: 100_000_000, 64: 1 << 40}
"""The largest usual integer, by width. Each doubling beyond it costs `UNUSUAL` bits more."""

USUAL_MIN = {16: 3_000, 32: 1_000_000, 64: 1 << 40}
"""The same for the amount of a negative integer."""

UNUSUAL = {16: 2.4, 32: 0.8, 64: 1.0}
NEGATIVE = 3.0
ALL_SET = 7.0

USUAL_MAGNITUDE = 1.5
MAGNITUDES = 2.2
"""The mean and the deviation of the decimal logarithm of usual floats."""

FEW_DIGITS = 4
FEW_BITS = 3
SMOOTH = 1 / 8
"""The largest change that counts as smooth, relative to the value."""

FAR = 1000
JUMP = 3.0
"""The change of an integer that is unusual between two reads, and its additional bits."""

SHARED = 0.5
"""A float that changes by more than this share is described anew."""

THIS_ERA = (1_262_304_000, 2_208_988_800)
"""The seconds of Unix time from 2010 to 2039."""

CLOCK_ERROR = 86_400
"""Seconds by which the clock of a device may usually differ."""


def description(
    found: Sequence[Any], kind: str, bits: int, now: float | None = None
) -> tuple[float, list[str]]:
    """The bits that describe the values of all reads, and the reasons as words.

    `now` is the time of the last read, in seconds of Unix time.
    """
    reasons: list[str] = []
    total = _value(found[0], kind, bits, now, reasons)
    smooth = []
    for before, after in itertools.pairwise(found):
        if before == after:
            total += SAME
            continue
        change, is_smooth = _change(before, after, kind)
        smooth.append(is_smooth)
        total += min(ANEW + _value(after, kind, bits, now, []), change)
    if smooth:
        if isinstance(found[0], str):
            reasons.append("changes")
        else:
            reasons.append("changes smoothly" if 2 * sum(smooth) > len(smooth) else "jumps")
    return total, reasons


def _value(value: Any, kind: str, bits: int, now: float | None, reasons: list[str]) -> float:
    if isinstance(value, str):
        reasons.append("printable text")
        padding = bits / 8 - len(value)
        return 4 + sum(map(_letter, value)) + padding / 2
    if isinstance(value, float):
        return _float(value, kind, reasons)
    if kind.startswith("bcd"):
        reasons.append("decimal digits only")
        return _integer(value, bits, reasons, is_decimal=True) + 1
    if value < 0:
        return _negative(-value, bits, reasons)
    if kind == "uint32" and THIS_ERA[0] <= value < THIS_ERA[1]:
        return _time(value, now, reasons)
    return _integer(value, bits, reasons)


def _integer(value: int, bits: int, reasons: list[str], *, is_decimal: bool = False) -> float:
    if value == 0:
        return 2.5
    cost = math.log2(value + 1) + SPREAD[bits] + _excess(value, USUAL_MAX[bits], bits)
    cost = min(cost, _round(value, bits))
    if bits == 16 and not is_decimal:  # The bits of a decimal number are not those of its value.
        if value == 0xFFFF:
            reasons.append("all bits set: often no value")
            return ALL_SET
        ones = value.bit_count()
        if value >= 256 and ones <= FEW_BITS:
            rare = 7 + math.log2(math.comb(16, ones))
            if rare < cost:
                reasons.append("few bits set")
                cost = rare
        if value % 256 == 0:
            cost = min(cost, 14 if value % 4096 else 10)
        return cost
    small = value < 1 << (bits // 2)
    reasons.append("small for its size" if small else "large" if value > USUAL_MAX[bits] else "")
    if not reasons[-1]:
        reasons.pop()
    return cost


def _negative(amount: int, bits: int, reasons: list[str]) -> float:
    if bits > 16 and amount > USUAL_MIN[bits]:
        reasons.append("large")
    unusual = 1.5 * _excess(amount, USUAL_MIN[bits], bits) / UNUSUAL[bits]
    plain = math.log2(amount + 1) + SPREAD[bits] + unusual
    return NEGATIVE + min(plain, _round(amount, bits))


def _excess(value: int, usual: int, bits: int) -> float:
    return max(0.0, math.log2(value / usual)) * UNUSUAL[bits]


def _round(value: int, bits: int) -> float:
    """The bits of a number of few digits, followed by zeros."""
    digits = len(str(value).rstrip("0"))
    return BITS_A_DIGIT * digits + 3 + math.log2(bits * 0.3)


def _time(value: int, now: float | None, reasons: list[str]) -> float:
    if now is not None and abs(value - now) < CLOCK_ERROR:
        reasons.append("the current Unix time")
        return 4 + math.log2(2 * CLOCK_ERROR)
    reasons.append("a Unix time of these years")
    return 3 + math.log2(THIS_ERA[1] - THIS_ERA[0])


def _float(value: float, kind: str, reasons: list[str]) -> float:
    """The bits of a float: its sign, magnitude and significant digits."""
    if value == 0:
        return 4.0 if math.copysign(1, value) > 0 else 16.0
    sign = 0.3 if value > 0 else NEGATIVE
    magnitude = (math.log10(abs(value)) - USUAL_MAGNITUDE) / MAGNITUDES
    text = shortest(value, kind)
    digits = len(text.partition("e")[0].replace(".", "").strip("-0"))
    if abs(magnitude) > 3:
        reasons.append("odd magnitude")
    elif digits <= FEW_DIGITS:
        reasons.append("few digits")
    else:
        reasons.append("plausible magnitude")
    mantissa = MANTISSAS[kind] + 1.7
    if kind != "float16":  # Most of its values have few digits: that is no evidence.
        mantissa = min(mantissa, 2 + BITS_A_DIGIT * digits)
    return sign + 2 + 0.72 * magnitude * magnitude + mantissa


def _change(before: Any, after: Any, kind: str) -> tuple[float, bool]:
    """The bits of a change, and whether it is smooth."""
    if isinstance(before, str):
        return math.inf, False
    change = abs(after - before)
    share = change / max(abs(before), abs(after))
    if isinstance(before, float):
        if share > SHARED:
            return math.inf, False
        steps = max(1.0, share * 2.0 ** (MANTISSAS[kind] - _unused(before, after, kind)))
        return 4 + math.log2(steps), share < SMOOTH
    jump = JUMP if change > FAR else 0.0
    return 4.5 + math.log2(change) + jump, share < SMOOTH or change <= 2


def _unused(before: float, after: float, kind: str) -> int:
    """How many of the last bits of the mantissas are zero in both."""
    form = {"e": "H", "f": "I", "d": "Q"}[FLOATS[kind]]
    both = 0
    for each in (before, after):
        both |= struct.unpack(f">{form}", struct.pack(f">{FLOATS[kind]}", each))[0]
    return min(MANTISSAS[kind], (both & -both).bit_length() - 1) if both else MANTISSAS[kind]


def _letter(letter: str) -> float:
    return 5 if letter.isalpha() or letter == " " else 5.5 if letter.isdigit() else 7.5
