"""Builds blocks of registers from rows: what a register contains, its type, and how it behaves.

A signal returns the five values that the reads of a device see. It draws from the generator of the
device only, so that a seed determines all blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from random import Random
from typing import Any, TypeAlias

from calibration.cases import EMPTY, EVERY_S, NOW, READS, Case, Truth
from holdfast.values import encode
from holdfast.values.types import parsed

NATURAL = "ABCD"
FILL = (0, 0xFFFF, 0x8000)
"""What registers without a value contain."""

LIMITS = {
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1),
    "uint64": (0, 2**64 - 1),
    "bcd16": (0, 9999),
    "bcd32": (0, 99_999_999),
}


@dataclass(frozen=True)
class Device:
    """One device, as it is while it is read."""

    chance: Random
    order: str = NATURAL
    """The order of numbers of several registers."""
    moves: bool = True
    """Whether measured values change between the reads."""
    idle: bool = False
    """Whether it does nothing: flows are 0."""
    refresh: int = 1
    """After so many reads the device measures anew."""
    digits: int | None = None
    """The decimals to which it rounds floats, `None` for all that it calculates."""
    padding: str = "\0"
    """What follows a text in its field."""
    text_order: str = NATURAL
    clock_s: float = NOW
    """The time of its clock at the last read."""

    def time(self, read: int) -> datetime:
        """Its clock at a read."""
        age = (READS - 1 - read) * EVERY_S if self.moves else 0.0
        return datetime.fromtimestamp(self.clock_s - age, UTC)


Signal: TypeAlias = Callable[[Device], Sequence[Any]]


@dataclass(frozen=True)
class Row:
    """A value of a register map."""

    what: str
    type: str
    signal: Signal = field(repr=False)
    order: str | None = None
    """The order if it is not the usual one of the device."""


def build(name: str, kind: str, rows: Sequence[Row], device: Device) -> Case:
    """The block of a device."""
    reads: list[list[int]] = [[] for _ in range(READS)]
    values = []
    for row in rows:
        order = _order(row, device)
        values.append(Truth(len(reads[0]), row.type, order, row.what))
        for read, value in zip(reads, row.signal(device), strict=True):
            if row.type == EMPTY:
                read.append(value)
            else:
                read.extend(encode(_fitted(value, row.type, device), row.type, order))
    case = Case(name, kind, any(read != reads[0] for read in reads), reads, values)
    case.check()
    return case


def _order(row: Row, device: Device) -> str:
    if row.order is not None:
        return row.order
    if row.type.startswith("string:"):
        return device.text_order
    if row.type == EMPTY or row.type.startswith("bytes:") or parsed(row.type).registers == 1:
        return NATURAL
    return device.order


def _fitted(value: Any, type: str, device: Device) -> Any:
    if type.startswith("string:"):
        size = parsed(type).parameter
        return value[:size].ljust(size, device.padding).rstrip("\0")
    if type in LIMITS:
        low, high = LIMITS[type]
        return min(max(round(value), low), high)
    if type.startswith("float") and device.digits is not None:
        return round(value, device.digits)
    return value


def still(value: Any) -> list[Any]:
    """The same value in every read."""
    return [value] * READS


def constant(*choices: Any) -> Signal:
    """One of the choices, for ever."""
    return lambda device: still(device.chance.choice(choices))


def between(low: int, high: int) -> Signal:
    """An integer for ever; all are equally probable."""
    return lambda device: still(device.chance.randint(low, high))


def magnitude(low: float, high: float) -> Signal:
    """A number for ever; all magnitudes are equally probable."""
    return lambda device: still(_magnitude(device.chance, low, high))


def _magnitude(chance: Random, low: float, high: float) -> float:
    return math.exp(chance.uniform(math.log(low), math.log(high)))


def near(
    mean: float, spread: float, noise: float, *, idle: float | None = None, low: float = -math.inf
) -> Signal:
    """A measured value: the mean of this device, and noise in every read; `idle` at rest."""

    def signal(device: Device) -> Sequence[float]:
        base = max(device.chance.gauss(mean, spread), low)
        if device.idle and idle is not None:
            return still(idle)
        if not device.moves:
            return still(base)
        steps = [device.chance.gauss(0, noise) for _ in range(READS)]
        return [max(base + steps[read // device.refresh], low) for read in range(READS)]

    return signal


def counter(low: float, high: float, rate: float, *, never: float = 0.0) -> Signal:
    """A counter that grows by `rate` a second; with the probability `never` it is still 0."""

    def signal(device: Device) -> Sequence[float]:
        if device.chance.random() < never:
            return still(0)
        base = _magnitude(device.chance, low, high)
        grows = device.moves and not device.idle
        pace = device.chance.uniform(0.3, 1.7) * rate * EVERY_S if grows else 0
        return [base + pace * (read // device.refresh) for read in range(READS)]

    return signal


def bits(width: int, share: float, *, toggles: bool = False) -> Signal:
    """A mask in which each bit is set with the probability `share`."""

    def signal(device: Device) -> Sequence[int]:
        mask = sum(1 << bit for bit in range(width) if device.chance.random() < share)
        flips = toggles and device.moves
        return [mask ^ (flips and device.chance.random() < 0.3) for _ in range(READS)]

    return signal


def text(pattern: str, *others: str) -> Signal:
    """One of the texts; `#` is any digit, `@` any letter, `?` any hexadecimal digit."""

    def signal(device: Device) -> Sequence[str]:
        chosen = device.chance.choice((pattern, *others))
        return still("".join(_letter(device.chance, letter) for letter in chosen))

    return signal


def _letter(chance: Random, letter: str) -> str:
    alphabet = {"#": "0123456789", "@": "ABCDEFGHJKLMNPRSTUVWXYZ", "?": "0123456789ABCDEF"}
    return chance.choice(alphabet[letter]) if letter in alphabet else letter


def octets(*parts: int | tuple[int, int]) -> Signal:
    """Bytes: those given, and any between two limits for a pair."""

    def signal(device: Device) -> Sequence[bytes]:
        content = (
            part if isinstance(part, int) else device.chance.randint(*part) for part in parts
        )
        return still(bytes(content))

    return signal


def epoch(*, hours: tuple[float, float] = (0, 0)) -> Signal:
    """Seconds of Unix time: the clock of the device, or a time so many hours before."""

    def signal(device: Device) -> Sequence[int]:
        if hours == (0, 0):
            return [int(device.time(read).timestamp()) for read in range(READS)]
        return still(int(device.clock_s - 3600 * device.chance.uniform(*hours)))

    return signal


def clock(form: Callable[[datetime], Any]) -> Signal:
    """A part of the clock of the device."""
    return lambda device: [form(device.time(read)) for read in range(READS)]


def past(form: Callable[[datetime], Any]) -> Signal:
    """A part of a date in the last years."""

    def signal(device: Device) -> Sequence[Any]:
        seconds = device.clock_s - device.chance.uniform(1, 1500) * 86_400
        return still(form(datetime.fromtimestamp(seconds, UTC)))

    return signal


def empty(count: int, content: int = 0) -> list[Row]:
    """Registers without a value."""
    return [Row("no value", EMPTY, lambda _: still(content)) for _ in range(count)]


def several(
    count: int, what: str, type: str, signal: Signal, order: str | None = None
) -> list[Row]:
    """Values of the same kind next to each other."""
    return [Row(what, type, signal, order) for _ in range(count)]
