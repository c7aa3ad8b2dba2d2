"""Describes a device that nobody documented, by reading only.

Asks what the device says about itself, decodes SunSpec models by their definitions, finds the
other addresses, reads them several times, and divides them into probable values. The result is a
list of tags that do not overlap, each with a confidence.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from holdfast.discovery import (
    address_search,
    byte_order_habits,
    segments,
    sunspec,
    sunspec_tags,
)
from holdfast.discovery.described_tag import DescribedTag
from holdfast.discovery.device_search import Identity
from holdfast.discovery.type_rarity import SIZES
from holdfast.errors import ModbusException
from holdfast.protocol import READ_LIMITS
from holdfast.tags import Tag
from holdfast.types import BIT_AREAS, SHORT_OF

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from holdfast.client import SyncClient
    from holdfast.discovery.address_search import Survey
    from holdfast.discovery.byte_order_habits import Habit
    from holdfast.discovery.segments import Value
    from holdfast.discovery.sunspec import SunSpec
    from holdfast.types import Area

SINGLE_BITS = 64
"""Ranges of more bits become tags of many bits each."""

MAX_BITS_PER_TAG = 256
MAX_REGISTERS_PER_TAG = READ_LIMITS["holding_registers"]

MIN_GAP_REGISTERS = 8
"""So many registers that contain nothing separate the values before them from those behind."""

MAX_CONFIDENCE = 0.99
"""The highest confidence of a guess."""

IMPROBABLE = 0.01
"""The probability up to which a habit is not considered."""

MAX_REGISTERS_AT_ONCE = 1000
"""Registers that are divided together, for some seconds: the time grows faster than their number,
and those before an interruption are described."""

MAX_REGISTERS_IN_A_HURRY = 100
"""The same, while time is limited."""

MAX_ORDER_REGISTERS = 400
"""Registers from which the order of a device is inferred; more would cost time only."""


@dataclass
class Description:
    """What is known about one unit id of a device, so far."""

    unit: int
    survey: Survey
    identity: Identity = field(default_factory=Identity)
    """As `device_search` has found it."""
    sunspec: SunSpec | None = None
    reads: dict[tuple[Area, range], list[list[int]]] = field(default_factory=dict)
    """The contents of each range that was read, of every read."""
    unread: dict[tuple[Area, range], str] = field(default_factory=dict)
    """Ranges that exist but could not be read again, and why."""
    seen: dict[Area, dict[int, int]] = field(default_factory=dict)
    """The contents that the survey read."""
    orders: Mapping[str, float] = field(default_factory=dict)
    """The probability of each order of the device; empty if no register says anything."""
    tags: list[DescribedTag] = field(default_factory=list)


def describe(
    found: Description,
    client: SyncClient,
    *,
    reads: int,
    every: float,
    delay: float,
    progress: Callable[[Survey], object] | None = None,
) -> None:
    """Carries out a description. Call `conclude` after it, also if an exception ended it early.

    Waits `delay` seconds before every request. All of them count towards the `max_requests` of the
    survey, and none is outside its span.

    Raises `ModbusError` if the device is silent, and `Unfinished` of the survey.
    """
    survey = found.survey

    def read(area: Area, address: int, kind: str) -> list[int]:
        if delay:
            time.sleep(delay)
        content: list[int] = client.read(area, address, kind, unit=found.unit)
        return content

    def read_more(area: Area, address: int, kind: str) -> list[int]:
        survey.count_request()
        return read(area, address, kind)

    def read_sunspec(address: int, count: int) -> list[int]:
        most = survey.max_quantity or READ_LIMITS["holding_registers"]
        extent = range(address, address + count)
        return list(_contents(read_more, "holding_registers", extent, most))

    def search(area: Area, address: int, kind: str) -> None:
        content = read(area, address, kind)
        found.seen.setdefault(area, {}).update(enumerate(content, address))

    if any(each.area == "holding_registers" for each in survey.areas):
        found.sunspec = sunspec.find(read_sunspec, survey.span)
    address_search.run_sync(survey, search, progress)
    if progress is not None:
        progress(survey)
    places = list(_places(found))
    for turn in range(reads):
        if turn and places:
            time.sleep(every)
        for area, extent, largest in places:
            if (area, extent) in found.unread:
                continue
            try:
                content = list(_contents(read_more, area, extent, largest))
            except ModbusException as error:
                found.unread[area, extent] = str(error)
                found.reads.pop((area, extent), None)
            else:
                found.reads.setdefault((area, extent), []).append(content)


def _places(found: Description) -> Iterator[tuple[Area, range, int]]:
    """The ranges to read, without those of SunSpec, and the largest read of their area."""
    known = found.sunspec.extent if found.sunspec is not None else range(0)
    for each in found.survey.areas:
        for extent in each.ranges:
            parts = [extent]
            if each.area == "holding_registers" and known:
                before = range(extent.start, min(extent.stop, known.start))
                behind = range(max(extent.start, known.stop), extent.stop)
                parts = [before, behind]
            for part in parts:
                if len(part):
                    yield each.area, part, max(1, each.largest)


def _contents(
    read: Callable[[Area, int, str], list[int]], area: Area, extent: range, largest: int
) -> Iterator[int]:
    kind = "bool" if area in BIT_AREAS else "uint16"
    step = min(largest, READ_LIMITS[area])
    for first in range(extent.start, extent.stop, step):
        count = min(step, extent.stop - first)
        yield from read(area, first, f"{kind}[{count}]")


def conclude(found: Description, now: float | None = None, seconds: float | None = None) -> None:
    """Infers the tags from what was read; from what the survey has seen, where it ended early.

    `now` is the time in seconds of Unix time. After `seconds`, and after an exception, the tags so
    far are there: `undescribed` has the other ranges.
    """
    end = None if seconds is None else time.monotonic() + seconds
    most = MAX_REGISTERS_AT_ONCE if end is None else MAX_REGISTERS_IN_A_HURRY
    for area, extent, _ in _places(found):
        if (area, extent) not in found.reads and (area, extent) not in found.unread:
            found.reads[area, extent] = [[found.seen[area][each] for each in extent]]
    areas = [each.area for each in found.survey.areas]
    if found.sunspec is not None:
        found.tags += sunspec_tags.tags_of(found.sunspec)
    for (area, extent), contents in found.reads.items():
        if area in BIT_AREAS:
            found.tags += _bits(area, extent, contents)
    try:
        pieces = list(_pieces(found))
        habits = _habits(pieces, now)
        found.orders = byte_order_habits.order_shares(habits)
        parts = (part for piece in pieces for part in _tags_by_part(piece, most, habits, now))
        while (end is None or time.monotonic() <= end) and (tags := next(parts, None)) is not None:
            found.tags += tags
    finally:
        found.tags.sort(key=lambda each: (areas.index(each.tag.area), each.tag.address))


def undescribed(found: Description) -> Iterator[tuple[Area, range]]:
    """The ranges that were found and have no tags, because `conclude` ended early."""
    ends = {(each.tag.area, each.tag.address): each.tag.end for each in found.tags}
    for area, extent, _ in _places(found):
        if (area, extent) in found.unread:
            continue
        first = at = extent.start
        while at < extent.stop:
            end = ends.get((area, at))
            if end is None:
                at += 1
                continue
            if first < at:
                yield area, range(first, at)
            first = at = end
        if first < extent.stop:
            yield area, range(first, extent.stop)


@dataclass(frozen=True)
class _Piece:
    """Consecutive registers, either all of interest or all without content."""

    area: Area
    address: int
    reads: list[list[int]]
    is_empty: bool

    def part(self, first: int, stop: int) -> _Piece:
        """Some of the registers."""
        reads = [read[first:stop] for read in self.reads]
        return replace(self, address=self.address + first, reads=reads)


def _pieces(found: Description) -> Iterator[_Piece]:
    """The registers that were read, divided where many contain nothing."""
    for (area, extent), contents in found.reads.items():
        if area in BIT_AREAS:
            continue
        start = 0
        for first, stop in (*_empty(contents), (len(extent), len(extent))):
            whole = _Piece(area, extent.start, contents, is_empty=False)
            if start < first:
                yield whole.part(start, first)
            if first < stop:
                yield replace(whole, is_empty=True).part(first, stop)
            start = stop


def _empty(reads: list[list[int]]) -> Iterator[tuple[int, int]]:
    """The runs of registers that contain nothing in any read."""
    first = 0
    size = len(reads[0])
    while first < size:
        content = reads[0][first]
        stop = first
        if content in segments.FILL:
            while stop < size and all(read[stop] == content for read in reads):
                stop += 1
        if stop - first >= MIN_GAP_REGISTERS:
            yield first, stop
        first = max(stop, first + 1)


def _habits(pieces: Sequence[_Piece], now: float | None) -> dict[Habit, float]:
    """The probability of each habit of the device, from the first pieces with content."""
    parts: list[list[list[int]]] = []
    seen = 0
    for piece in pieces:
        if not piece.is_empty and seen < MAX_ORDER_REGISTERS:
            parts.append([read[: MAX_ORDER_REGISTERS - seen] for read in piece.reads])
            seen += len(parts[-1][0])
    if not parts:
        return {}
    shares = segments.habits(parts, now=now)
    return {habit: share for habit, share in shares.items() if share > IMPROBABLE}


def _tags_by_part(
    piece: _Piece, most: int, habits: Mapping[Habit, float], now: float | None
) -> Iterator[list[DescribedTag]]:
    """The tags of `most` registers at a time.

    The last value of a part may go on in the next one, and is found there.
    """
    first, size = 0, len(piece.reads[0])
    while first < size:
        stop = size if piece.is_empty else min(first + most, size)
        tags = list(_values(piece.part(first, stop), habits, now))
        if stop < size and len(tags) > 1:
            stop = tags.pop().tag.address - piece.address
        yield tags
        first = stop


def _values(
    piece: _Piece, habits: Mapping[Habit, float], now: float | None
) -> Iterator[DescribedTag]:
    if piece.is_empty:
        yield from _filled(piece)
        return
    division = segments.divide(piece.reads, now=now, habits=habits, is_open=False)
    for value, chance in division.best:
        sure = segments.confidence(chance, value.kind)
        if not any(value.found) or value.reasons == (segments.FILL_REASONS[0xFFFF],):
            sure = min(sure, segments.NOTHING_KNOWN)
        yield _described(piece, value, min(sure, MAX_CONFIDENCE))


def _filled(piece: _Piece) -> Iterator[DescribedTag]:
    """Registers that contain nothing, in tags of limited size."""
    content = piece.reads[0][0]
    size = len(piece.reads[0])
    for first in range(0, size, MAX_REGISTERS_PER_TAG):
        count = min(MAX_REGISTERS_PER_TAG, size - first)
        reasons = (segments.FILL_REASONS[content],)
        kind = "uint16" if count == 1 else f"uint16[{count}]"
        tag = _tag(piece.area, piece.address + first, kind, "ABCD", segments.NOTHING_KNOWN, reasons)
        yield DescribedTag(tag, segments.NOTHING_KNOWN, (content,) * len(piece.reads), reasons)


def _described(piece: _Piece, value: Value, confidence: float) -> DescribedTag:
    kind = value.type
    if kind == segments.PART:
        kind = "uint16"
        confidence = min(confidence, segments.NOTHING_KNOWN)
    reasons = value.reasons if any(value.found) else (segments.FILL_REASONS[0],)
    if value.also is not None and any(value.found):
        reasons = (*reasons, f"or {value.also}")
    size = SIZES.get(value.kind, value.registers)
    if size < value.registers:
        kind = f"{kind}[{value.registers // size}]"
    tag = _tag(piece.area, piece.address + value.offset, kind, value.order, confidence, reasons)
    return DescribedTag(tag, confidence, value.found, reasons)


def _bits(area: Area, extent: range, contents: Sequence[Sequence[int]]) -> Iterator[DescribedTag]:
    size = 1 if len(extent) <= SINGLE_BITS else MAX_BITS_PER_TAG
    for first in range(0, len(extent), size):
        count = min(size, len(extent) - first)
        kind = "bool" if count == 1 else f"bool[{count}]"
        found = tuple(
            bool(read[first]) if count == 1 else [bool(bit) for bit in read[first : first + count]]
            for read in contents
        )
        reasons = ("changes",) if any(each != found[0] for each in found) else ()
        address = extent.start + first
        tag = Tag(f"{SHORT_OF[area]}_{address}", area, address, kind)
        yield DescribedTag(tag, 1.0, found, reasons)


def _tag(
    area: Area, address: int, kind: str, order: str, confidence: float, reasons: Sequence[str]
) -> Tag:
    text = f"confidence {confidence:.2f}{': ' if reasons else ''}{', '.join(reasons)}"
    return Tag(f"{SHORT_OF[area]}_{address}", area, address, kind, order, description=text)
