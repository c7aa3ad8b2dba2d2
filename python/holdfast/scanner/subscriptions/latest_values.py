"""The latest value of each tag, for callers that come late.

It keeps the bytes of blocks instead of values: that costs a poll nothing per tag.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.scanner.subscriptions.health import without_overlap
from holdfast.tags.decoding import Undecoded, value_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.scanner.subscriptions.tag import ScannedTag
    from holdfast.types import Area, PolledBlock

MAX_BLOCKS = 4096
"""Limit of kept blocks of a device. A device has more only while a refused block is bisected."""


class Latest(NamedTuple):
    """The latest value of a tag, and the time of the device's response in seconds."""

    value: Any
    time: float


class LatestBlocks:
    """The latest bytes of each block of a device."""

    def __init__(self) -> None:
        self._blocks: dict[tuple[Area, int, int], tuple[bytes, float]] = {}

    def take(self, blocks: Iterable[PolledBlock]) -> None:
        """Keeps the blocks that were read."""
        for area, address, count, data, _, time in blocks:
            if data is None:
                continue
            place = (area, address, count)
            if place not in self._blocks:  # The plan has changed, so former blocks may overlap.
                self._forget_inside(area, address, address + count)
            self._blocks[place] = (data, time)

    def forget_except(self, blocks: Sequence[PolledBlock]) -> None:
        """Forgets the blocks that overlap none of these: no tag needs them any more."""
        if self._blocks.keys() <= {block[:3] for block in blocks}:  # Nearly always.
            return
        for place in without_overlap(self._blocks, blocks):
            del self._blocks[place]

    def value(self, tag: ScannedTag) -> Latest | None:
        """Returns the latest value of a tag; `None` if it was never read.

        A value that can't be decoded is `None`.
        """
        found: tuple[float, int, bytes] | None = None
        span = tag.span
        for (area, address, count), (data, time) in self._blocks.items():
            inside = area == tag.area and address <= span.start and span.stop <= address + count
            if inside and (found is None or time > found[0]):
                found = (time, address, data)
        if found is None:
            return None
        time, address, data = found
        value = value_of(tag, data, address)
        if type(value) is Undecoded:
            return Latest(None, time)
        return Latest(tag.published(tag.value(value)), time)

    def _forget_inside(self, area: Area, start: int, end: int) -> None:
        """Removes the blocks that a new one contains, and the oldest if there are too many."""
        self._blocks = {
            place: kept
            for place, kept in self._blocks.items()
            if place[0] != area or place[1] < start or place[1] + place[2] > end
        }
        while len(self._blocks) >= MAX_BLOCKS:
            del self._blocks[next(iter(self._blocks))]
