"""Random registers as devices have them, with the type of the value in the first of them.

Each device has one byte order and neighbours of usual types; values change between reads as
measurements, counters, setpoints and states do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast import values

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

WORDS = ("PUMP", "Boiler", "FIRMWARE", "Meter", "SN", "Rev", "UNIT", "Motor", "ACME")
REGISTERS = 4


@dataclass(frozen=True)
class Sample:
    """Reads of some registers, and what the first of them are."""

    kind: str
    order: str
    reads: list[list[int]]
    about: str


def sample(random: random.Random, reads: int = 4) -> Sample:
    """A value of a random kind, with what a device may have behind it."""
    about = random.choices(list(KINDS), [weight for weight, _ in KINDS.values()])[0]
    order = random.choices(("ABCD", "CDAB"), (3, 2))[0]
    kind, series = KINDS[about][1](random, reads)
    registers = [_encoded(each, kind, order) for each in series]
    behind: Callable[[], list[list[int]]] = random.choice(
        [
            lambda: [[0] * REGISTERS] * reads,
            lambda: _neighbours(random, about, order, reads),
            lambda: _neighbours(random, random.choice(list(KINDS)), order, reads),
        ]
    )
    rest = behind()
    whole = [(own + other)[:REGISTERS] for own, other in zip(registers, rest, strict=True)]
    if kind.startswith("string"):
        whole = [own[: max(REGISTERS, len(own))] for own in registers]
    shown = order if len(registers[0]) > 1 and not kind.startswith("string") else "ABCD"
    return Sample(kind, shown, whole, about)


def _encoded(value: Any, kind: str, order: str) -> list[int]:
    return values.encode(value, kind, "ABCD" if kind.startswith("string") else order)


def _neighbours(random: random.Random, about: str, order: str, reads: int) -> list[list[int]]:
    rest: list[list[int]] = [[] for _ in range(reads)]
    while len(rest[0]) < REGISTERS:
        kind, series = KINDS[about][1](random, reads)
        for own, each in zip(rest, series, strict=True):
            own += _encoded(each, kind, order)
    return rest


def _counted(random: random.Random, kind: str, least: float, most: float, reads: int) -> Any:
    value = int(10 ** random.uniform(least, most))
    pace = random.choice((0, 1, 3, 20))
    series = [value]
    for _ in range(reads - 1):
        series.append(series[-1] + random.randint(0, pace))
    return kind, series


def _measured(
    random: random.Random,
    kind: str,
    least: float,
    most: float,
    reads: int,
    digits: int | None = None,
) -> Any:
    mean = random.uniform(least, most)
    noise = abs(mean) * random.choice((0, 1e-4, 1e-3, 1e-2)) + (most - least) * 1e-4
    series = [random.gauss(mean, noise) for _ in range(reads)]
    if kind in ("int16", "uint16", "int32", "uint32"):
        whole = [round(each) for each in series]
        return kind, [max(0, each) for each in whole] if kind[0] == "u" else whole
    if digits is not None:
        series = [round(each, digits) for each in series]
    return kind, series


def _negative(random: random.Random, kind: str, most: float, reads: int) -> Any:
    kind, series = _measured(random, kind, most / 100, most, reads)
    return kind, [-max(1, each) for each in series]


def _state(random: random.Random, reads: int) -> Any:
    return "uint16", [random.choice((0, 1, 1, 2, 3, 4, 5, 8, 16))] * reads


def _status(random: random.Random, reads: int) -> Any:
    word = sum(1 << bit for bit in random.sample(range(16), random.choice((1, 2, 3))))
    return "uint16", [word] * reads


def _setpoint(random: random.Random, reads: int) -> Any:
    return "uint16", [random.randint(1, 100) * random.choice((1, 5, 10, 50, 100))] * reads


def _text(random: random.Random, reads: int) -> Any:
    text = f"{random.choice(WORDS)}{random.choice(('-', ' ', ''))}{random.randint(1, 9999)}"
    size = 4 * -(-len(text) // 4)
    return f"string:{size}", [text] * reads


KINDS: dict[str, tuple[float, Callable[[random.Random, int], tuple[str, list[Any]]]]] = {
    "measurement in tenths": (10, lambda r, n: _measured(r, "uint16", 50, 6000, n)),
    "setpoint": (6, _setpoint),
    "state": (5, _state),
    "status word": (3, _status),
    "small counter": (4, lambda r, n: _counted(r, "uint16", 1, 4.6, n)),
    "negative temperature": (5, lambda r, n: _negative(r, "int16", 600, n)),
    "negative power": (3, lambda r, n: _negative(r, "int32", 200000, n)),
    "energy counter": (10, lambda r, n: _counted(r, "uint32", 4.9, 8.5, n)),
    "long energy counter": (1, lambda r, n: _counted(r, "uint64", 7, 11, n)),
    "voltage": (8, lambda r, n: _measured(r, "float32", 215, 245, n)),
    "temperature": (8, lambda r, n: _measured(r, "float32", -30, 120, n)),
    "rounded temperature": (5, lambda r, n: _measured(r, "float32", -30, 120, n, 1)),
    "power factor": (3, lambda r, n: _measured(r, "float32", 0.5, 1, n)),
    "power": (6, lambda r, n: _measured(r, "float32", 50, 90000, n)),
    "volume": (2, lambda r, n: _measured(r, "float64", 10, 1e6, n)),
    "text": (4, _text),
}
"""Kinds of values: how common each is, and how its type and its series of values are made."""
