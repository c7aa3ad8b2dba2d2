"""How plausible a sequence of values is for a type, in bits: the length of a short description.

A usual value has a short description: small integers, round numbers, floats of usual magnitude or
with few digits, text. A later value is described by its change. Registers that are read with a
wrong type or order have long descriptions, so descriptions of the same registers can be compared.

The bits are the logarithm of a probability, so two things must hold. The probabilities of all
values of a type add up to about 1: a short description of some is paid for by the others. And a
value that never changed may be no measurement at all, but a serial number, an address or a bit
field: `_constant` describes those, so that no constant registers are rarer than any 32 bits.
"""

from __future__ import annotations

import itertools
import math
import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.discovery import ip_plausibility
from holdfast.values.digits import FLOATS, shortest

if TYPE_CHECKING:
    from collections.abc import Sequence

MANTISSAS = {"float16": 10, "float32": 23, "float64": 52}

BITS_A_DIGIT = math.log2(10)
SAME = 0.5
ANEW = 3.0
"""Bits for a value that equals the one before, and for one that has nothing to do with it."""

SPREAD = {16: 3.5, 32: 4.6, 64: 5.5}
"""Bits for the size of an integer, by its width."""

USUAL_MAX = {16: 10_000, 32: 100_000_000, 64: 1 << 40}
"""The largest usual integer, by width. Each doubling beyond it costs `UNUSUAL` bits more."""

USUAL_MIN = {16: 3_000, 32: 1_000_000, 64: 1 << 40}
"""The same for the amount of a negative integer."""

UNUSUAL = {16: 2.4, 32: 0.8, 64: 1.0}
ZERO = {16: 1.8, 32: 2.7, 64: 2.5}
"""Bits for zero: one register in four contains it."""

NEGATIVE = 3.0
MIN_BITS = 11.0
"""The bits of the least integer and of half of it, as limits have: those of a bit field."""

ALL_SET = 7.0

USUAL_MAGNITUDE = 1.5
MAGNITUDES = 2.2
"""The mean and the deviation of the decimal logarithm of usual floats."""

EXACT_DIGITS = 15
ROUNDED_DIGITS = 6
"""The most digits of floats that seem to be rounded: they change by steps of the last digit."""

ROUNDED = 2.0
STILL = 1.0
"""How rare it is that a device rounds floats that change to few digits, and that a float of all
digits does not change, in bits.
"""

FAR_BEHIND = 99
"""The digits behind the point of a float that is written with an exponent."""

FEW_DIGITS = 4
FEW_BITS = 3
SMOOTH = 1 / 8
"""The largest change that counts as smooth, relative to the value."""

FAR = 1000
JUMP = 3.0
"""The change of an integer that is unusual between two reads, and its additional bits."""

STEPS = {"uint16": 4.0, "int16": 4.0, "uint32": 4.0, "int32": 4.0, "uint64": 4.2, "int64": 4.2,
         "float32": 4.8, "float64": 4.5}  # fmt: skip
OTHER_STEP = 5.0
"""The bits of a change by one step, by type. A change of k steps has a probability of 1/k, so its
bits and those of all others add up if they are 1 + log2(ln(largest change)): 3.8 for 1000 steps.
"""

FLIPS = {"uint16": 8.0, "uint32": 10.0}
"""The bits of a change of one bit, as status words have it."""

SHARED = 0.5
"""A float that changes by more than this share is described anew."""

THIS_ERA_S = (1_262_304_000, 2_208_988_800)
"""The seconds of Unix time from 2010 to 2039."""

TIME = 4.0
OTHER_TIME = 7.0
RECENT_S = 5 * 365 * 86_400
"""How rare times are among long integers, in bits; those that are neither now nor of the last years
are rarer.
"""

CLOCK_ERROR_S = 86_400
"""Seconds by which the clock of a device may usually differ."""

UNSIGNED = ("uint16", "uint32", "uint64")
ANY_BITS = {16: 5.0, 32: 2.0, 64: 6.0}
"""How rare unsigned integers are whose bits may be any, by width: one long one in four has a serial
number, a checksum or a status of 32 bits.
"""

BOTH_REGISTERS = 1.2
STILL_IN_BOTH = 2.2
"""How rare it is that a number of 32 bits needs both registers, in bits: most counters of devices
began lately, and states, set points and powers are small. Two registers that never change are still
more often two numbers.
"""

FIELD_BITS = 4
FIELD = 7.5
"""The most bits that are set in a bit field of which that is typical, and how rare it is."""

ALIKE = 0.35
NEAR = 2.0
MAX_ALIKE = 9.0
"""How many values are like their neighbour of the same type; the bits for it beside those of the
difference; and what it can save at most: more would decide alone, and the halves of long values
are alike too.
"""


class Description(NamedTuple):
    """How long the description of the values of all reads is."""

    bits: float
    later: float
    """The part of the bits for the reads after the first."""
    reasons: tuple[str, ...]


def description(
    found: Sequence[Any], kind: str, bits: int, now: float | None = None
) -> Description:
    """Describes the values of all reads; `now` is the time of the last, in seconds of Unix time."""
    reasons: list[str] = []
    first = _value(found[0], kind, bits, now, reasons)
    later = 0.0
    smooth = []
    for before, after in itertools.pairwise(found):
        if before == after:
            later += SAME
            continue
        smooth.append(_is_smooth(before, after))
        changed = change(before, after, kind)
        later += min(ANEW + _value(after, kind, bits, now, []), changed)
    if smooth:
        reasons.append("changes smoothly" if 2 * sum(smooth) > len(smooth) else "jumps")
    if kind in FLOATS and len(found) > 1:
        first += _precision(_decimal(found[0], kind)[0], is_still=not smooth)
    total = first + later
    if not smooth and kind in UNSIGNED:
        total = min(total, _constant(found[0], bits))
    if kind == "uint32" and found[0] > 0xFFFF:
        total += BOTH_REGISTERS if smooth else STILL_IN_BOTH
    return Description(total, later, tuple(reasons))


def _precision(digits: int, *, is_still: bool) -> float:
    """The bits for the digits of a float beside its change: what is measured has many and changes,
    what a person sets has few and stays.
    """
    if is_still:
        return STILL if digits > ROUNDED_DIGITS else 0.0
    return ROUNDED if digits <= FEW_DIGITS else 0.0


def likeness(near: Sequence[Any], described: Description, after: Any, kind: str) -> float:
    """The bits that a value saves if the same type is before it: neighbours are often alike, as the
    three voltages of a meter are. Negative for values that are not alike.

    `near` are the values before it, the nearest first.
    """
    if not near or not near[0] or not after or kind not in STEPS:
        return 0.0
    alike = min(far + change(before, after, kind) for far, before in enumerate(near) if before)
    saved = described.bits - described.later - NEAR - alike
    return math.log2(1 - ALIKE + ALIKE * 2.0 ** min(MAX_ALIKE, saved))


def _constant(value: int, bits: int) -> float:
    """The bits of an unsigned integer that identifies something or is a bit field."""
    cost = bits + ANY_BITS[bits]
    ones = value.bit_count()
    if bits != 32:
        return cost
    if 0 < ones <= FIELD_BITS:
        cost = min(cost, FIELD + math.log2(math.comb(bits, ones)))
    return min(cost, ip_plausibility.description(value))


def _value(value: Any, kind: str, bits: int, now: float | None, reasons: list[str]) -> float:
    if isinstance(value, float):
        return _float(value, kind, reasons)
    if kind.startswith("bcd"):
        reasons.append("decimal digits only")
        return _integer(value, bits, reasons, is_decimal=True) + 1
    if value < 0:
        return _negative(-value, bits, reasons)
    if kind == "uint32" and THIS_ERA_S[0] <= value < THIS_ERA_S[1]:
        return _time(value, now, reasons)
    return _integer(value, bits, reasons)


def _integer(value: int, bits: int, reasons: list[str], *, is_decimal: bool = False) -> float:
    if value == 0:
        return ZERO[bits]
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
    if value < 1 << (bits // 2):
        reasons.append("small for its size")
    elif value > USUAL_MAX[bits]:
        reasons.append("large")
    return cost


def _negative(amount: int, bits: int, reasons: list[str]) -> float:
    if bits > 16 and amount > USUAL_MIN[bits]:
        reasons.append("large")
    if amount.bit_count() == 1 and amount >> (bits - 2):
        return MIN_BITS
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
    if now is not None and abs(value - now) < CLOCK_ERROR_S:
        reasons.append("the current Unix time")
        return TIME + math.log2(2 * CLOCK_ERROR_S)
    reasons.append("a Unix time of these years")
    if now is not None and now - RECENT_S < value < now:
        return TIME + math.log2(RECENT_S)
    return (TIME if now is None else OTHER_TIME) + math.log2(THIS_ERA_S[1] - THIS_ERA_S[0])


def _float(value: float, kind: str, reasons: list[str]) -> float:
    """The bits of a float: its sign, magnitude and significant digits."""
    if value == 0:
        return 4.0 if math.copysign(1, value) > 0 else 16.0
    sign = 0.3 if value > 0 else NEGATIVE
    magnitude = (math.log10(abs(value)) - USUAL_MAGNITUDE) / MAGNITUDES
    digits, _ = _decimal(value, kind)
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


@lru_cache(4096)
def _decimal(value: float, kind: str) -> tuple[int, int]:
    """The significant digits of a float, and those behind the point."""
    text = shortest(value, kind)
    digits = len(text.partition("e")[0].replace(".", "").strip("-0"))
    if digits > EXACT_DIGITS:  # A product such as 7 * 0.1 differs from 0.7 in the last bit.
        rounded = f"{value:.{EXACT_DIGITS}g}"
        shorter = len(rounded.partition("e")[0].replace(".", "").strip("-0")) + 1
        if shorter < digits:
            text, digits = rounded, shorter
    return digits, FAR_BEHIND if "e" in text else len(text.partition(".")[2])


def change(before: Any, after: Any, kind: str) -> float:
    """The bits of a change from one value to another: those of its steps, with its direction."""
    if before == after:
        return SAME
    amount = abs(after - before)
    step = STEPS.get(kind, OTHER_STEP)
    if isinstance(before, float):
        share = amount / max(abs(before), abs(after))
        if share > SHARED:
            return math.inf
        steps = share * 2.0 ** (MANTISSAS[kind] - _unused(before, after, kind))
        (digits, decimals), (more_digits, more) = _decimal(before, kind), _decimal(after, kind)
        if max(digits, more_digits) <= ROUNDED_DIGITS:
            steps = min(steps, 2 * amount * 10.0 ** max(decimals, more))
        return step + math.log2(max(1.0, steps))
    cost = step + math.log2(amount) + (JUMP if amount > FAR else 0.0)
    if kind in FLIPS and (before ^ after).bit_count() == 1:
        cost = min(cost, FLIPS[kind])
    return cost


def _is_smooth(before: Any, after: Any) -> bool:
    """Whether a change is small."""
    amount = abs(after - before)
    if amount <= SMOOTH * max(abs(before), abs(after)):
        return True
    return not isinstance(before, float) and amount <= 2


def _unused(before: float, after: float, kind: str) -> int:
    """How many of the last bits of the mantissas are zero in both."""
    form = {"e": "H", "f": "I", "d": "Q"}[FLOATS[kind]]
    both = 0
    for each in (before, after):
        both |= struct.unpack(f">{form}", struct.pack(f">{FLOATS[kind]}", each))[0]
    return min(MANTISSAS[kind], (both & -both).bit_length() - 1) if both else MANTISSAS[kind]
