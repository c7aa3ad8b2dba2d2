"""Divides registers into values of types that describe all of them best.

A division is a sequence of values without gaps and overlaps. Its weight is that of its types and
orders, and of the description of each value (`plausibility`). All registers of a device have one
order, and neighbours are often of one type and alike. The probability of a value is the share of
the weights of all divisions that contain it; `confidence` is what this probability is worth.

Nothing is certain because it is the best description: what else the registers may be has its
share. Text may go on in several fields, the last register may belong to a value beyond it, and
constants may be numbers that mean nothing.
"""

from __future__ import annotations

import itertools
import math
import struct
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast import values
from holdfast.discovery import clock_fields, plausibility, text_fields
from holdfast.discovery.byte_order_habits import (
    COMMON,
    HABITS,
    ORDER_HABITS,
    ORDERS,
    PREFERENCES,
    Habit,
)
from holdfast.discovery.type_rarity import NARROW, RARITY_BITS, SIZES, rarity
from holdfast.values import ConversionError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    Key: TypeAlias = tuple[str, str]
    Place: TypeAlias = tuple[str, str, int]
    Likely: TypeAlias = tuple["Value", float]

PART = "part"
CUT_OFF = 19.0
CUT_OFF_ZERO = 9.0
CUT_OFF_ALIKE = 7.0
CUT_OFF_CHANGE = 16.0
CUT_OFF_STEP = 3.0
"""The type of a last register that may belong to a value beyond it, and its bits: those of any
content, of the zeros in front of a long integer, of a beginning like that of the value before it,
and of each change.
"""

TRUST = {"float32": 1.4, "int32": 0.65, "string": 0.6, "uint16": 0.76}
OTHER_TRUST = 0.78
"""The power of the odds that makes a confidence from a probability, by type. The bits of neighbours
are not independent, so probabilities promise too much, least for floats: half of their bits are
none of neighbours, and nearly always say the same. The length of a text and the sign of a number
depend on few bits. The powers are those with which so many claims about simulated devices
(`tests/calibration`) are true as their confidence says.
"""

NEGLIGIBLE = 1e-6
"""The probability up to which a habit is not considered."""

IMPROBABLE = 8.0
"""The bits by which an order is worse than the best if its preferences are not considered."""

SAME_TYPE = 0.4
OTHER_TYPE = 0.2
"""The bits for the type of a neighbour: the same again, or any, which has the bits of its rarity
besides.
"""

FILL = {0: 2.3, 0xFFFF: 6.0}
FILLED = {0: 0.7, 0xFFFF: 0.3}
FILL_REASONS = {0: "always 0", 0xFFFF: "all bits set: often no value"}
"""The bits of registers that contain nothing: of all, of each, and why. Zeros are not free: behind
a number, they are as often its high word or values at rest.
"""

LATER = plausibility.SAME
"""The bits of a text that is the same again."""

NOTHING = ("", "")
"""The type and order of registers that contain nothing: they follow values of each type as often,
so the register behind a number is not its own because it continues a type.
"""

NOTHING_KNOWN = 0.3
"""The confidence in the type of registers that contain nothing."""

SIGNED = {"uint16": "int16", "uint32": "int32", "uint64": "int64"}
UNSIGNED = {signed: unsigned for unsigned, signed in SIGNED.items()}


@dataclass(frozen=True)
class Value:
    """A value in registers: a possible one, or one of a division."""

    type: str
    order: str
    offset: int
    registers: int
    found: tuple[Any, ...]
    """The decoded value of each read."""
    bits: float
    """The length of its description, without that of its type."""
    reasons: tuple[str, ...]
    also: str | None = None
    """Another type that decodes to the same values in all reads."""
    saved: float = 0.0
    """The bits that the description saves behind a value of the same type and order."""
    is_nothing: bool = False
    """Whether these are registers that contain nothing."""

    @cached_property
    def kind(self) -> str:
        """The type without its length."""
        return self.type.partition(":")[0]

    @cached_property
    def key(self) -> Key:
        """The order, and the type without length and sign: a negative number between others is no
        other type. Registers that contain nothing have no type.
        """
        if self.is_nothing:
            return NOTHING
        return UNSIGNED.get(self.kind, self.kind), self.order

    @property
    def stop(self) -> int:
        """The register after the value."""
        return self.offset + self.registers


@dataclass(frozen=True, slots=True)
class Division:
    """The divisions of registers: the best one, and how probable each value is."""

    best: tuple[Likely, ...]
    """The values of the best division, each with the probability that it is one."""
    starting: tuple[tuple[Likely, ...], ...]
    """For each register, the values that can start there, most probable first; their probabilities
    are those if a value starts there.
    """
    habits: Mapping[Habit, float]
    """The probability of each habit of the device."""


def divide(
    reads: Sequence[Sequence[int]],
    *,
    now: float | None = None,
    habits: Mapping[Habit, float] | None = None,
    is_open: bool = True,
) -> Division:
    """Divides registers. Every read has the same number of registers, at least one.

    `now` is the time of the last read in seconds of Unix time. `habits` is the probability of each
    habit of the device; without it, the registers themselves decide. `is_open` means that more
    registers may follow.
    """
    possible = _possible(reads, now, is_open)
    if habits is None:
        totals, known = _totals([possible])
        habits = _shares(totals)
        lattices = [each for [each] in known]
    else:
        lattices = [_Lattice(possible, habit) for habit in habits]
    lattices = [each for each in lattices if habits[each.habit] > NEGLIGIBLE]
    chances: list[dict[Place, Likely]] = [{} for _ in reads[0]]
    for lattice in lattices:
        for value in lattice.values():
            at = chances[value.offset]
            place = value.type, value.order, value.stop
            _, before = at.get(place, (value, 0.0))
            at[place] = value, before + habits[lattice.habit] * lattice.chance(value)
    joined = [_with_padding(each) for each in chances]
    best = tuple(
        (value, min(1.0, joined[value.offset][value.type, value.order, value.stop][1]))
        for value in _best(chances)
    )
    return Division(best, tuple(_ranked(each.values()) for each in joined), habits)


def confidence(chance: float, kind: str = "") -> float:
    """The share of claims of a type with this probability that are true."""
    if not 0.0 < chance < 1.0:
        return chance
    odds: float = (chance / (1.0 - chance)) ** TRUST.get(kind, OTHER_TRUST)
    return odds / (1.0 + odds)


def _best(chances: Sequence[Mapping[Place, Likely]]) -> list[Value]:
    """The division of which most registers are probably divided right, whatever the habit of the
    device is.
    """
    right = [0.0, *[-math.inf] * len(chances)]
    last: dict[int, Value] = {}
    for at, found in enumerate(chances):
        for value, chance in found.values():
            total = right[at] + value.registers * chance
            if total > right[value.stop]:
                right[value.stop] = total
                last[value.stop] = value
    chosen = []
    stop = len(chances)
    while stop:
        chosen.append(last[stop])
        stop = last[stop].offset
    return chosen[::-1]


def _with_padding(found: dict[Place, Likely]) -> dict[Place, Likely]:
    """The values that start at a register, each text with the probability of all fields that differ
    in their padding only: the text is right if any of them is.
    """
    whole: dict[tuple[Any, ...], float] = {}
    for value, chance in found.values():
        if value.kind == "string":
            same = (value.order, value.found)
            whole[same] = whole.get(same, 0.0) + chance
    if not whole:
        return found
    return {
        key: (value, whole.get((value.order, value.found), chance))
        for key, (value, chance) in found.items()
    }


def habits(
    parts: Iterable[Sequence[Sequence[int]]], *, now: float | None = None
) -> dict[Habit, float]:
    """The probability of each habit of a device, from the reads of several parts."""
    totals, _ = _totals([_possible(reads, now, is_open=False) for reads in parts])
    return _shares(totals)


def _totals(
    parts: Sequence[Sequence[Sequence[Value]]],
) -> tuple[dict[Habit, float], list[list[_Lattice]]]:
    """The weight of each habit of a device, and with it the divisions of each part. Preferences are
    considered in probable orders only.
    """
    totals: dict[Habit, float] = {}
    found: list[list[_Lattice]] = []
    orders = list(ORDER_HABITS)
    for preference in PREFERENCES:
        for order in orders:
            habit = Habit(order.order, order.swaps_registers, preference)
            found.append([_Lattice(possible, habit) for possible in parts])
            totals[habit] = sum(each.total for each in found[-1]) - HABITS[habit]
        best = max(totals.values())
        orders = [each for each in orders if totals[each] > best - IMPROBABLE]
    return totals, found


def _shares(weights: Mapping[Habit, float]) -> dict[Habit, float]:
    """Probabilities from their logarithms."""
    whole = _sum(weights.values())
    return {habit: 2 ** (weight - whole) for habit, weight in weights.items()}


def _ranked(found: Iterable[Likely]) -> tuple[Likely, ...]:
    """Values by their probability among each other; texts that differ in padding are one, and so
    are registers that contain nothing and the first of them.
    """
    ranked: list[Likely] = []
    texts: set[Key] = set()
    known: dict[Key, Likely] = {}
    for value, chance in found:
        first, before = known.get((value.type, value.order), (value, 0.0))
        known[value.type, value.order] = first, before + chance
    for value, chance in sorted(known.values(), key=lambda each: (-each[1], each[0].bits)):
        text = value.order, value.found[0]
        if value.kind != "string" or text not in texts:
            ranked.append((value, chance))
            texts.add(text)
    whole = sum(chance for _, chance in ranked) or 1.0
    return tuple((value, chance / whole) for value, chance in ranked)


class _Lattice:
    """All divisions with one habit of the device."""

    def __init__(self, possible: Sequence[Sequence[Value]], habit: Habit) -> None:
        self.habit = habit
        self._size = len(possible)
        self._from = [[each for each in found if _fits(each, habit)] for found in possible]
        # Sums over all divisions of the registers before a place; and of those ending with a kind.
        self._before: list[float] = [0.0]
        self._ending: list[dict[Key, float]] = [{} for _ in range(self._size + 1)]
        # The same of the registers after a place, and of those beginning with a kind: the former
        # with how rare the first type is, the latter without.
        self._after = [0.0] * (self._size + 1)
        self._beginning: list[dict[Key, float]] = [{} for _ in range(self._size + 1)]
        self._forward()
        self._backward()
        self.total = self._before[self._size]

    def values(self) -> Iterator[Value]:
        """All possible values."""
        return itertools.chain.from_iterable(self._from)

    def chance(self, value: Value) -> float:
        """The probability that a value is one, with this habit."""
        before, ahead = self._entering(value), self._ahead(value)
        return float(2 ** (before - value.bits + ahead - self.total))

    def _entering(self, value: Value) -> float:
        """The weight of all that is before a value, and of its type."""
        at = value.offset
        any_type = self._before[at] - _rarity(value, self.habit)
        if at == 0:
            return any_type
        same = self._ending[at].get(value.key)
        if same is None:
            return any_type - OTHER_TYPE
        return _either(any_type - OTHER_TYPE, same - SAME_TYPE + value.saved)

    def _ahead(self, value: Value) -> float:
        """The weight of all that is behind a value."""
        stop = value.stop
        if stop == self._size:
            return 0.0
        same = self._beginning[stop].get(value.key)
        if same is None:
            return self._after[stop] - OTHER_TYPE
        return _either(self._after[stop] - OTHER_TYPE, same - SAME_TYPE)

    def _forward(self) -> None:
        incoming: list[list[Value]] = [[] for _ in range(self._size + 1)]
        for value in self.values():
            incoming[value.stop].append(value)
        for stop in range(1, self._size + 1):
            ending = self._ending[stop]
            for value in incoming[stop]:
                weight = self._entering(value) - value.bits
                ending[value.key] = _either(ending.get(value.key, -math.inf), weight)
            self._before.append(_sum(ending.values()))

    def _backward(self) -> None:
        for at in range(self._size - 1, -1, -1):
            beginning = self._beginning[at]
            each: list[float] = []
            for value in self._from[at]:
                weight = self._ahead(value) - value.bits
                known = beginning.get(value.key, -math.inf)
                beginning[value.key] = _either(known, weight + value.saved)
                each.append(weight - _rarity(value, self.habit))
            self._after[at] = _sum(each)


def _rarity(value: Value, habit: Habit) -> float:
    """How rare the type and order of a value are in a device with this habit."""
    if value.is_nothing or value.type == PART:
        return 0.0
    return rarity(value.kind, value.order, habit)


def _fits(value: Value, habit: Habit) -> bool:
    """Whether a device with this habit may have the value."""
    if value.kind == "string" or value.type == PART or value.registers > SIZES[value.kind]:
        return True
    if value.kind in NARROW:
        return (value.order == "BADC") == habit.swaps_registers
    return value.order == habit.order or value.order in COMMON


def _possible(
    reads: Sequence[Sequence[int]], now: float | None, is_open: bool
) -> list[list[Value]]:
    """The values that can start at each register, in any order."""
    possible: list[list[Value]] = []
    numbers: list[dict[Key, Value]] = []
    for at in range(len(reads[0])):
        found = _numbers(reads, at, now, numbers)
        numbers.append({(value.type, value.order): value for value in found})
        others = _others(reads, at, now, is_open)
        possible.append([*others, *numbers[-1].values()])
    return possible


def _numbers(
    reads: Sequence[Sequence[int]],
    at: int,
    now: float | None,
    before: Sequence[Mapping[Key, Value]],
) -> Iterator[Value]:
    """The numbers that can start at a register, in any order; `before` are those of the registers
    before it.
    """
    left = len(reads[0]) - at
    for kind, registers in SIZES.items():
        if registers > left:
            continue
        earlier = [before[place] for place in (at - registers, at - 2 * registers) if place >= 0]
        for order in ORDERS if registers > 1 else ("ABCD", "BADC"):
            near = [each[kind, order].found[0] for each in earlier if (kind, order) in each]
            value = _value(reads, at, kind, order, registers, now, near)
            if value is not None:
                yield value


def _value(
    reads: Sequence[Sequence[int]],
    at: int,
    kind: str,
    order: str,
    registers: int,
    now: float | None,
    near: Sequence[Any],
) -> Value | None:
    """A possible number; `None` if it is invalid, or equal to that of another type. `near` are the
    numbers of this type before it, the nearest first.
    """
    try:
        found = _decoded(reads, at, registers, kind, order)
    except ConversionError:
        return None
    if isinstance(found[0], float):
        if not all(map(math.isfinite, found)):
            return None
    elif kind.startswith("int") and min(found) >= 0:
        return None
    also = SIGNED.get(kind)
    if also is not None and max(found) >= 1 << (16 * registers - 1):
        also = None
    described = plausibility.description(found, kind, 16 * registers, now)
    saved = plausibility.likeness(near, described, found[0], kind)
    bits, _, reasons = described
    return Value(kind, order, at, registers, found, bits, reasons, also, saved)


def _decoded(
    reads: Sequence[Sequence[int]], at: int, registers: int, kind: str, order: str
) -> tuple[Any, ...]:
    """The value of each read; most never change, and are decoded once."""
    first = reads[0][at : at + registers]
    value = values.decode(first, kind, order)
    parts = [read[at : at + registers] for read in reads]
    return tuple(value if part == first else values.decode(part, kind, order) for part in parts)


def _others(
    reads: Sequence[Sequence[int]], at: int, now: float | None, is_open: bool
) -> Iterator[Value]:
    """What can start at a register and is no number: nothing, text, a clock, part of a value."""
    fill = _fill(reads, at, is_open)
    if fill is not None:
        yield fill
    for order in ("ABCD", "BADC"):
        yield from _texts(reads, at, order, is_open)
    clock = _clock(reads, at, now)
    if clock is not None:
        yield clock
    if at > 0 and at + 1 == len(reads[0]):
        yield _part(reads, at)


def _part(reads: Sequence[Sequence[int]], at: int) -> Value:
    """The last register as the beginning of a value beyond it."""
    found = tuple(read[at] for read in reads)
    bits = CUT_OFF if any(found) else CUT_OFF_ZERO
    step = CUT_OFF_STEP
    if at > 1:
        alike = CUT_OFF_ALIKE + 2 * math.log2(1 + abs(found[0] - reads[0][at - 2]))
        if alike < bits:
            bits, step = alike, 0.0
    for before, after in itertools.pairwise(found):
        bits += min(CUT_OFF_CHANGE, step + plausibility.change(before, after, "uint16"))
    return Value(PART, "ABCD", at, 1, found, bits, ())


def _fill(reads: Sequence[Sequence[int]], at: int, is_open: bool) -> Value | None:
    """Registers that contain nothing: all of them 0, or all bits set; `None` for less than two."""
    content = reads[0][at]
    if content not in FILL:
        return None
    registers = min(_prefix(read[at:], content) for read in reads)
    if registers < 2:
        return None
    found = tuple(content for _ in reads)
    is_rest = not is_open and not content and at + registers == len(reads[0])
    bits = 0.0 if is_rest else FILL[content] + FILLED[content] * registers
    reasons = (FILL_REASONS[content],)
    return Value(
        "uint16", "ABCD", at, registers, found, bits, reasons, saved=-math.inf, is_nothing=True
    )


def _clock(reads: Sequence[Sequence[int]], at: int, now: float | None) -> Value | None:
    """A date and time in decimal digits, of several registers; `None` if it is none in a read."""
    clock = clock_fields.description([read[at:] for read in reads], now)
    if clock is None:
        return None
    found = tuple(values.decode(read[at : at + 1], "bcd16") for read in reads)
    bits, registers = clock
    return Value("bcd16", "ABCD", at, registers, found, bits, ("date and time in decimal digits",))


def _texts(reads: Sequence[Sequence[int]], at: int, order: str, is_open: bool) -> Iterator[Value]:
    """The texts that can start at a register, in fields of different lengths."""
    parts = [read[at : at + text_fields.MAX_TEXT_BYTES // 2] for read in reads]
    contents = [_bytes(part, order) for part in parts]
    for field in text_fields.fields(contents, is_open=is_open):
        registers = field.length // 2
        kind = PART if field.goes_on else f"string:{field.length}"
        text = f"string:{field.length}"
        found = tuple(values.decode(part[:registers], text, order) for part in parts)
        bits = field.bits + LATER * (len(reads) - 1)
        bits += RARITY_BITS["string"] if field.goes_on else 0
        reasons = ["printable text"]
        if _changes(found):
            bits += _changes(found) * field.bits
            reasons.append("changes")
        yield Value(kind, order, at, registers, found, bits, tuple(reasons))


def _bytes(registers: Sequence[int], order: str) -> bytes:
    data = struct.pack(f">{len(registers)}H", *registers)
    if order == "ABCD":
        return data
    swapped = bytearray(data)
    swapped[::2], swapped[1::2] = data[1::2], data[::2]
    return bytes(swapped)


def _changes(found: Sequence[Any]) -> int:
    return sum(before != after for before, after in itertools.pairwise(found))


def _prefix(registers: Sequence[int], content: int) -> int:
    return next((at for at, each in enumerate(registers) if each != content), len(registers))


def _either(one: float, other: float) -> float:
    """The sum of two numbers whose logarithms are given, as a logarithm."""
    most, least = (one, other) if one > other else (other, one)
    if least == -math.inf:
        return most
    return most + math.log2(1.0 + 2.0 ** (least - most))


def _sum(weights: Iterable[float]) -> float:
    """The sum of numbers whose logarithms are given, as a logarithm."""
    known = list(weights)
    most = max(known, default=-math.inf)
    if most == -math.inf:
        return most
    return most + math.log2(sum([2.0 ** (each - most) for each in known]))
