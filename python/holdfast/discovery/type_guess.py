"""Guesses the type and byte order of registers from their values in several reads.

The score of a guess is its probability among all types and orders, from how common each is and how
plausible its values are together with those in the registers behind them (`segments`). A rare type
requires evidence: values that are much more plausible than those of common types. Registers that
are 0 say nothing about their type. Text that goes on behind the registers that were read has a
length that nobody knows: its type gets a small score. A known value takes precedence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.discovery import segments

if TYPE_CHECKING:
    from holdfast.discovery.segments import Value

SCALES = {1.0: 0.0, 0.1: 1.0, 0.01: 1.5, 0.001: 3.0, 10.0: 3.0}
"""Scales of integers to try for a known value, and how unusual each is, in bits."""

PLAUSIBLE = 12.0
"""The maximum weight of all other criteria with a known value, in bits."""

CLOSEST = 1e-6
UNLIKE = 0.1


@dataclass(frozen=True)
class Guess:
    """A possible type of registers."""

    type: str
    order: str
    offset: int
    """Registers before the value."""
    values: tuple[Any, ...]
    """The decoded value of each read."""
    score: float
    """0 to 1: the probability, if a value starts there. With a known value, only for ranking."""
    reasons: tuple[str, ...]
    """Reasons for and against the guess."""
    also: str | None = None
    """Another type that decodes to the same values in all reads."""
    scale: float = 1.0
    """The factor that scales the value to the known value."""


def guess(
    reads: Sequence[Sequence[int]],
    *,
    like: float | None = None,
    anywhere: bool = False,
    now: float | None = None,
) -> list[Guess]:
    """Guesses the type of registers from several reads. Returns the best guess first.

    Values start at the first register, or with `anywhere` at any register. `like` is the known
    value of one of the reads: guesses are then ranked by their distance to it, and distant guesses
    are omitted. `now` is the time of the last read in seconds of Unix time: clocks are recognised.
    """
    if not reads or not reads[0] or any(len(read) != len(reads[0]) for read in reads):
        raise ValueError("all reads require the same number of registers, at least one")
    division = segments.divide(reads, now=now)
    guesses = [
        found
        for starting in division.starting[: None if anywhere else 1]
        for value, chance in starting
        if value.type != segments.PART
        for found in _guesses(value, chance, like)
    ]
    return sorted(guesses, key=lambda each: -each.score)


def _guesses(value: Value, chance: float, like: float | None) -> Iterator[Guess]:
    """A value as a guess; with a known value, in all scales that come close to it."""
    if like is None:
        sure = segments.confidence(chance, value.kind)
        yield _guess(value, sure if any(value.found) else sure * segments.NOTHING_KNOWN)
        return
    if isinstance(value.found[0], str):
        return
    plausible = PLAUSIBLE + max(-2 * PLAUSIBLE, math.log2(max(chance, 1e-300)))
    for scale, unusual in SCALES.items():
        if scale != 1 and isinstance(value.found[0], float):
            continue
        off = min(_distance(each * scale, like) for each in value.found)
        if off <= UNLIKE:
            close = -math.log2(max(off, CLOSEST)) - unusual
            near = "equal" if off < CLOSEST else f"{100 * off:.2g} % off"
            yield _guess(value, _score(5 * close + plausible - 40), near, scale)


def _guess(value: Value, score: float, near: str | None = None, scale: float = 1.0) -> Guess:
    reasons = value.reasons if near is None else (near, *value.reasons)
    return Guess(
        value.type, value.order, value.offset, value.found, score, reasons, value.also, scale
    )


def _score(bits: float) -> float:
    return 1 / (1 + 2 ** (-bits / 5))


def _distance(value: float, like: float) -> float:
    """The distance of a value to a known value, relative to the known value."""
    return abs(value - like) / (abs(like) or 1.0)
