"""Divides registers into values of types that describe all of them best.

A division is a sequence of values without gaps and overlaps. Its weight is that of its types and
orders, and of the description of each value (`plausibility`). All registers of a device have one
order, and neighbours are often of one type. The probability of a value is the share of the weights
of all divisions that contain it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast import values
from holdfast.tools import clock_fields, plausibility
from holdfast.values import ConversionError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    Key: TypeAlias = tuple[str, str]

PART = "part"
CUT_OFF = 19.0
CUT_OFF_CHANGE = 16.0
"""The type of a last register that may belong to a value beyond it, and its bits."""

RARE = {
    "uint16": 1.3,
    "int16": 1.8,
    "float32": 2.3,
    "uint32": 2.8,
    "int32": 3.5,
    "float64": 7.0,
    "uint64": 6.5,
    "int64": 8.0,
    "bcd16": 11.0,
    "bcd32": 11.0,
    "float16": 13.0,
    "string": 6.0,
    PART: 0.0,
}
"""How rare a type is among the values of devices, in bits."""

SIZES = {kind: values.register_count(kind) for kind in RARE if kind not in ("string", PART)}
"""The registers of a value of each type."""

NARROW = {PART, *(kind for kind, size in SIZES.items() if size == 1)}
"""The types of one register, in which words have no order."""

ORDERS = {"ABCD": 0.6, "CDAB": 1.8, "DCBA": 6.0, "BADC": 6.0}
"""How rare an order is among devices, in bits."""

COMMON = ("ABCD", "CDAB")
MIXED = 4.0
"""The common orders, and how rare it is that a value has one that is not that of its device."""

SWAPPED_BYTES = ("BADC", "DCBA")
"""The orders of devices that may also swap the bytes of single registers."""

NEGLIGIBLE = 1e-6
"""The probability up to which an order is not considered."""

SWAPPED_TEXT = 3.0
SWAPPED_REGISTER = 5.0
"""How rare it is that bytes are swapped only in text, or in single registers too, in bits."""

SAME_TYPE = -math.log2(0.5)
OTHER_TYPE = -math.log2(0.5)
"""The bits for the type of a neighbour: the same again, or any."""

FILL = {0: 1.5, 0xFFFF: 6.0}
FILLED = 0.3
FILL_REASONS = {0: "always 0", 0xFFFF: "all bits set: often no value"}
"""The bits of registers that contain nothing: of all, of each, and why."""

CLOCK = 27.0
"""The bits of a date and time in decimal digits."""

SIGNED = {"uint16": "int16", "uint32": "int32", "uint64": "int64"}
MIN_TEXT = 3
MAX_TEXT = 64
"""The least and the most bytes of text."""

TEXT_SIZE = 16
"""Text is padded up to a multiple of so many bytes at most."""


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

    @cached_property
    def key(self) -> Key:
        """The type without its length, and the order."""
        return self.type.partition(":")[0], self.order

    @property
    def kind(self) -> str:
        """The type without its length."""
        return self.key[0]

    @property
    def stop(self) -> int:
        """The register after the value."""
        return self.offset + self.registers


@dataclass(frozen=True, slots=True)
class Division:
    """The divisions of registers: the best one, and how probable each value is."""

    best: tuple[tuple[Value, float], ...]
    """The values of the best division, each with the probability that it is one."""
    starting: tuple[tuple[tuple[Value, float], ...], ...]
    """For each register, the values that can start there, most probable first; their probabilities
    are those if a value starts there.
    """
    shares: Mapping[str, float]
    """The probability of each order of the device."""


def divide(
    reads: Sequence[Sequence[int]],
    *,
    now: float | None = None,
    shares: Mapping[str, float] | None = None,
) -> Division:
    """Divides registers. Every read has the same number of registers, at least one.

    `now` is the time of the last read in seconds of Unix time. `shares` is the probability of each
    order of the device; without it, the registers themselves decide.
    """
    possible = _possible(reads, now)
    if shares is None:
        lattices = [_Lattice(possible, order) for order in ORDERS]
        shares = _shares({each.order: each.total - ORDERS[each.order] for each in lattices})
    else:
        lattices = [_Lattice(possible, order) for order in shares]
    lattices = [each for each in lattices if shares[each.order] > NEGLIGIBLE]
    chances: list[dict[Key, tuple[Value, float]]] = [{} for _ in reads[0]]
    for lattice in lattices:
        for value in lattice.values():
            at = chances[value.offset]
            _, before = at.get((value.type, value.order), (value, 0.0))
            chance = before + shares[lattice.order] * lattice.chance(value)
            at[value.type, value.order] = value, chance
    best = max(lattices, key=lambda each: shares[each.order]).best()
    return Division(
        tuple((each, min(1.0, chances[each.offset][each.type, each.order][1])) for each in best),
        tuple(_ranked(each.values()) for each in chances),
        shares,
    )


def order_shares(
    parts: Iterable[Sequence[Sequence[int]]], *, now: float | None = None
) -> dict[str, float]:
    """The probability of each order of a device, from the reads of several parts."""
    weights = {order: -rare for order, rare in ORDERS.items()}
    for reads in parts:
        possible = _possible(reads, now)
        for order in weights:
            weights[order] += _Lattice(possible, order).total
    return _shares(weights)


def _shares(weights: Mapping[str, float]) -> dict[str, float]:
    """Probabilities from their logarithms."""
    whole = _sum(weights.values())
    return {order: 2 ** (weight - whole) for order, weight in weights.items()}


def _ranked(found: Iterable[tuple[Value, float]]) -> tuple[tuple[Value, float], ...]:
    """Values by their probability among each other."""
    ranked = sorted(found, key=lambda each: (-each[1], each[0].bits))
    whole = sum(chance for _, chance in ranked) or 1.0
    return tuple((value, chance / whole) for value, chance in ranked)


class _Lattice:
    """All divisions with one order of the device."""

    def __init__(self, possible: Sequence[Sequence[Value]], order: str) -> None:
        self.order = order
        self._size = len(possible)
        self._from = [[each for each in found if _fits(each, order)] for found in possible]
        # Sums over all divisions of the registers before a place; and of those ending with a kind.
        self._before: list[float] = [0.0]
        self._ending: list[dict[Key, float]] = [{} for _ in range(self._size + 1)]
        self._forward()
        self._after, self._beginning = self._backward()
        self.total = self._before[self._size]

    def values(self) -> Iterator[Value]:
        """All possible values."""
        for each in self._from:
            yield from each

    def chance(self, value: Value) -> float:
        """The probability that a value is one, with this order."""
        stop = value.stop
        ahead = _sum(
            (
                self._after[stop] - OTHER_TYPE,
                self._beginning[stop].get(value.key, -math.inf) - SAME_TYPE,
            )
        )
        if stop == self._size:
            ahead = 0.0
        before = self._entering(value, self._before, self._ending, _sum)
        return float(2 ** (before - value.bits + ahead - self.total))

    def best(self) -> list[Value]:
        """The values of the best division."""
        before = [0.0]
        ending: list[dict[Key, float]] = [{} for _ in range(self._size + 1)]
        last: list[dict[Key, Value]] = [{} for _ in range(self._size + 1)]
        incoming = self._incoming()
        for stop in range(1, self._size + 1):
            for value in incoming[stop]:
                weight = self._entering(value, before, ending, max) - value.bits
                if weight > ending[stop].get(value.key, -math.inf):
                    ending[stop][value.key] = weight
                    last[stop][value.key] = value
            before.append(max(ending[stop].values(), default=-math.inf))
        chosen: list[Value] = []
        stop = self._size
        key = max(ending[stop], key=ending[stop].__getitem__)
        while True:
            value = last[stop][key]
            chosen.append(value)
            stop = value.offset
            if stop == 0:
                return chosen[::-1]
            same = ending[stop].get(key, -math.inf) - SAME_TYPE
            if before[stop] - OTHER_TYPE - _rarity(value, self.order) > same:
                key = max(ending[stop], key=ending[stop].__getitem__)

    def _entering(
        self,
        value: Value,
        before: Sequence[float],
        ending: Sequence[Mapping[Key, float]],
        joined: Callable[[Iterable[float]], float],
    ) -> float:
        """The weight of all that is before a value, and of its type."""
        at = value.offset
        any_type = before[at] - _rarity(value, self.order)
        if at == 0:
            return any_type
        same = ending[at].get(value.key, -math.inf) - SAME_TYPE
        return joined((any_type - OTHER_TYPE, same))

    def _incoming(self) -> list[list[Value]]:
        """The values that end before each place."""
        incoming: list[list[Value]] = [[] for _ in range(self._size + 1)]
        for value in self.values():
            incoming[value.stop].append(value)
        return incoming

    def _forward(self) -> None:
        incoming = self._incoming()
        for stop in range(1, self._size + 1):
            ending = self._ending[stop]
            for value in incoming[stop]:
                weight = self._entering(value, self._before, self._ending, _sum) - value.bits
                ending[value.key] = _sum((ending.get(value.key, -math.inf), weight))
            self._before.append(_sum(ending.values()))

    def _backward(self) -> tuple[list[float], list[dict[Key, float]]]:
        """The sums over all divisions of the registers after a place, and of those that begin with
        a kind: the former with how rare the first type is, the latter without.
        """
        after = [0.0] * (self._size + 1)
        beginning: list[dict[Key, float]] = [{} for _ in range(self._size + 1)]
        for at in range(self._size - 1, -1, -1):
            each: list[float] = []
            for value in self._from[at]:
                stop = value.stop
                ahead = 0.0
                if stop < self._size:
                    same = beginning[stop].get(value.key, -math.inf) - SAME_TYPE
                    ahead = _sum((after[stop] - OTHER_TYPE, same))
                weight = ahead - value.bits
                known = beginning[at].get(value.key, -math.inf)
                beginning[at][value.key] = _sum((known, weight))
                each.append(weight - _rarity(value, self.order))
            after[at] = _sum(each)
        return after, beginning


def _rarity(value: Value, order: str) -> float:
    """How rare the type and order of a value are in a device with this order."""
    rare = RARE[value.kind]
    if value.kind == "string":
        return rare + (SWAPPED_TEXT if (value.order == "BADC") != (order in SWAPPED_BYTES) else 0)
    if value.kind in NARROW:
        return rare + (SWAPPED_REGISTER if value.order == "BADC" else 0)
    return rare + (MIXED if value.order != order else 0)


def _fits(value: Value, order: str) -> bool:
    """Whether a device with this order may have the value."""
    if value.kind == "string":
        return True
    if value.kind in NARROW:
        return value.order == "ABCD" or order in SWAPPED_BYTES
    return value.order == order or value.order in COMMON


def _possible(reads: Sequence[Sequence[int]], now: float | None) -> list[list[Value]]:
    """The values that can start at each register, in any order."""
    return [list(_values(reads, at, now)) for at in range(len(reads[0]))]


def _values(reads: Sequence[Sequence[int]], at: int, now: float | None) -> Iterator[Value]:
    """The values that can start at a register, in any order."""
    left = len(reads[0]) - at
    fill = _fill(reads, at)
    if fill is not None:
        yield fill
    yield from _texts(reads, at)
    for kind, registers in SIZES.items():
        if registers > left:
            continue
        for each in ORDERS if registers > 1 else ("ABCD", "BADC"):
            value = _value(reads, at, kind, each, registers, now)
            if value is not None:
                yield value
    clock = clock_fields.length(reads[-1][at:])
    value = _clock(reads, at, clock) if clock else None
    if value is not None:
        yield value
    if left == 1 and at > 0:
        found = tuple(read[at] for read in reads)
        bits = CUT_OFF + CUT_OFF_CHANGE * _changes(found)
        yield Value(PART, "ABCD", at, 1, found, bits, ())


def _value(
    reads: Sequence[Sequence[int]],
    at: int,
    kind: str,
    order: str,
    registers: int,
    now: float | None,
) -> Value | None:
    """A possible value; `None` if it is invalid, or equal to that of another type."""
    try:
        found = tuple(values.decode(read[at : at + registers], kind, order) for read in reads)
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
    bits, reasons = plausibility.description(found, kind, 16 * registers, now)
    return Value(kind, order, at, registers, found, bits, tuple(reasons), also)


def _fill(reads: Sequence[Sequence[int]], at: int) -> Value | None:
    """Registers that contain nothing: all of them 0, or all bits set; `None` for less than two."""
    content = reads[0][at]
    if content not in FILL:
        return None
    registers = min(_prefix(read[at:], lambda each: each == content) for read in reads)
    if registers < 2:
        return None
    found = tuple(content for _ in reads)
    bits = FILL[content] + FILLED * registers
    return Value("uint16", "ABCD", at, registers, found, bits, (FILL_REASONS[content],))


def _clock(reads: Sequence[Sequence[int]], at: int, registers: int) -> Value | None:
    """A date and time in decimal digits, of several registers; `None` if it is none in a read."""
    if any(clock_fields.length(read[at:]) != registers for read in reads):
        return None
    found = tuple(values.decode(read[at : at + 1], "bcd16") for read in reads)
    bits = CLOCK + 6 * _changes([read[at : at + registers] for read in reads])
    return Value("bcd16", "ABCD", at, registers, found, bits, ("date and time in decimal digits",))


def _texts(reads: Sequence[Sequence[int]], at: int) -> Iterator[Value]:
    """Text that starts at a register and ends where something else begins."""
    for each in ("ABCD", "BADC"):
        length = _text_length(reads, at, each)
        if not length:
            continue
        kind, registers = f"string:{length}", length // 2
        found = tuple(values.decode(read[at : at + registers], kind, each) for read in reads)
        bits, reasons = plausibility.description(found, kind, 8 * length)
        yield Value(kind, each, at, registers, found, bits, tuple(reasons))


def _text_length(reads: Sequence[Sequence[int]], at: int, order: str) -> int:
    """The bytes of text, with padding, that all reads have at a register; 0 without text."""
    lengths = []
    for read in reads:
        part = read[at : at + MAX_TEXT // 2]
        data = bytes(values.decode(part, f"bytes:{2 * len(part)}", order))
        letters = _prefix(data, lambda byte: 0x20 <= byte < 0x7F)
        if letters < MIN_TEXT or not data[:letters].strip():
            return 0
        most = -(-letters // TEXT_SIZE) * TEXT_SIZE
        end = letters + _prefix(data[letters:most], lambda byte: byte == 0)
        lengths.append(end - end % 2)
    return min(lengths) if min(lengths) >= MIN_TEXT else 0


def _changes(found: Sequence[Any]) -> int:
    return sum(before != after for before, after in itertools.pairwise(found))


def _prefix(data: Sequence[int], belongs: Callable[[int], bool]) -> int:
    return next((at for at, byte in enumerate(data) if not belongs(byte)), len(data))


def _sum(weights: Iterable[float]) -> float:
    """The sum of numbers whose logarithms are given, as a logarithm."""
    known = list(weights)
    most = max(known, default=-math.inf)
    if most == -math.inf:
        return most
    return most + math.log2(sum([2.0 ** (each - most) for each in known]))
