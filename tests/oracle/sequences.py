"""Blocks whose values have a known order: those of one writer, and those that a device had.

A read sees one of the values in that order: none that came after the read has ended, none before a
value that was surely there when the read began, and none before what a read saw that had ended by
then. Values may repeat. Taking the first place that is possible, read by read, finds an explanation
if there is one.
"""

from __future__ import annotations

import bisect
import heapq
import math
from typing import TYPE_CHECKING, NamedTuple

from oracle.violation import Violation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from oracle.history import Operation
    from oracle.layout import Block


class Step(NamedTuple):
    """A value in the order of a block."""

    value: int
    begin: float
    """Nobody can see it in a read that ended before."""
    end: float
    """Every read that begins later sees it, or a later one. Infinite if there is no such time."""


class Sight(NamedTuple):
    """A value that an operation has seen."""

    operation: Operation
    value: int


START = -math.inf


def deviations(block: Block, steps: list[Step], sights: Iterable[Sight]) -> Iterator[Violation]:
    """The reads that no place in the order explains. The first step is the initial value."""
    places: dict[int, list[int]] = {}
    for place, step in enumerate(steps):
        places.setdefault(step.value, []).append(place)
    sure = sorted((step.end, place) for place, step in enumerate(steps))
    seen: list[tuple[float, int]] = []
    floor = next_sure = 0
    for sight in sorted(sights, key=lambda one: one.operation.begin):
        begin, end = sight.operation.begin, sight.operation.end
        while next_sure < len(sure) and sure[next_sure][0] < begin:
            floor = max(floor, sure[next_sure][1])
            next_sure += 1
        while seen and seen[0][0] < begin:
            floor = max(floor, heapq.heappop(seen)[1])
        possible = places.get(sight.value, [])
        at = bisect.bisect_left(possible, floor)
        if at < len(possible) and steps[possible[at]].begin <= end:
            heapq.heappush(seen, (end, possible[at]))
        else:
            yield _deviation(block, steps, sight, possible, floor)


def _deviation(
    block: Block, steps: list[Step], sight: Sight, possible: list[int], floor: int
) -> Violation:
    what = f"{block.name}: {sight.value} was read"
    known = f"when {steps[floor].value} or a later value was there"
    if not possible:
        kind, text = "invented", f"{what}, which nobody wrote"
    elif possible[-1] < floor:
        kind, text = "backwards", f"{what} {known}"
    else:
        kind, text = "future", f"{what} before it was there, {known}"
    return Violation(kind, text, (sight.operation,))


def places_of(steps: list[Step], sight: Sight) -> list[int]:
    """The places in the order at which an operation may have been, by the times alone."""
    begin, end = sight.operation.begin, sight.operation.end
    # Steps of one writer: both begins and ends rise.
    first = max(0, bisect.bisect_left(steps, begin, key=lambda step: step.end) - 1)
    found = []
    for place in range(first, len(steps)):
        if steps[place].begin > end:
            break
        is_over = place + 1 < len(steps) and steps[place + 1].end < begin
        if steps[place].value == sight.value and not is_over:
            found.append(place)
    return found
