"""Tracks changes between readings: when, how often and how fast."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.live.sources import WatchedRange

RATE_WINDOW_S = 10.0
"""A rate is computed over this time."""

MAX_CHANGES = 64
"""Maximum number of changes of an address from which a rate is computed."""


@dataclass
class History:
    """The changes of an address."""

    changes: int = 0
    last: float = 0.0
    """The time of the last change."""
    reading: int = 0
    """The number of the reading with the last change."""
    steps: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=MAX_CHANGES))
    """The time and size of the last changes."""
    since: float = 0.0
    """The time of the reading before the first of these steps."""

    def rate(self, now: float) -> float:
        """The change per second over the last `RATE_WINDOW_S` seconds; 0 without recent changes."""
        if now - self.last > RATE_WINDOW_S or now <= self.since:
            return 0.0
        return sum(step for _, step in self.steps) / (now - self.since)


@dataclass(frozen=True)
class Change:
    """An address whose value changed."""

    block: WatchedRange
    address: int
    was: int
    now: int


class Tracker:
    """Compares readings of blocks."""

    def __init__(self, blocks: Sequence[WatchedRange]) -> None:
        self.blocks = blocks
        self.values: list[list[int]] = []
        """The last reading of each block."""
        self.readings = 0
        self.histories: dict[tuple[int, int], History] = {}
        """The addresses that ever changed, by index of the block and address."""
        self.at = 0.0
        """The time of the last reading."""

    def update(self, moment: float, values: Sequence[Sequence[int]]) -> list[Change]:
        """Adds a reading. Returns the changes since the reading before."""
        self.readings += 1
        changes = []
        for index, (block, now) in enumerate(zip(self.blocks, values, strict=True)):
            if not self.values or self.values[index] == now:
                continue
            pairs = enumerate(zip(self.values[index], now, strict=True), block.address)
            for address, (was, value) in pairs:
                if was != value:
                    self._note(index, address, moment, _step(block, was, value))
                    changes.append(Change(block, address, int(was), int(value)))
        self.values = [list(each) for each in values]
        self.at = moment
        return changes

    def age(self, index: int, address: int) -> int | None:
        """How many readings ago an address of a block changed; `None` if never."""
        history = self.histories.get((index, address))
        return None if history is None else self.readings - history.reading

    def latest(self, most: int) -> list[tuple[WatchedRange, int, int, History]]:
        """Range, address, value and history of the latest changes, in order of addresses."""
        places = sorted(self.histories, key=lambda place: -self.histories[place].reading)
        found = []
        for index, address in sorted(places[:most]):
            block = self.blocks[index]
            value = int(self.values[index][address - block.address])
            found.append((block, address, value, self.histories[index, address]))
        return found

    def _note(self, index: int, address: int, moment: float, step: int) -> None:
        history = self.histories.setdefault((index, address), History())
        if not history.steps or moment - history.last > RATE_WINDOW_S:
            history.steps.clear()
            history.since = self.at
        elif len(history.steps) == MAX_CHANGES:
            history.since = history.steps[0][0]
        while history.steps and moment - history.steps[0][0] > RATE_WINDOW_S:
            history.since, _ = history.steps.popleft()
        history.steps.append((moment, step))
        history.changes += 1
        history.last = moment
        history.reading = self.readings


def _step(block: WatchedRange, was: int, now: int) -> int:
    """The change of a register, across the wrap at 65535 if that is smaller; 1 for a bit."""
    if block.area in BIT_AREAS:
        return 1
    return (now - was + 0x8000) % 0x10000 - 0x8000
