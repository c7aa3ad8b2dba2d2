"""Describes a device that nobody documented, by reading only.

Asks what the device says about itself, decodes SunSpec models by their definitions, finds the
other addresses, reads them several times, and divides them into probable values. The result is a
list of tags that do not overlap, each with a confidence.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

from holdfast import values
from holdfast.client.requests import REFUSALS
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
from holdfast.errors import ModbusError, ModbusException
from holdfast.protocol import ILLEGAL_FUNCTION, READ_LIMITS
from holdfast.tags import Tag
from holdfast.types import BIT_AREAS, SHORT_OF

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from holdfast.client import SyncClient
    from holdfast.discovery.address_search import AreaMap, Survey
    from holdfast.discovery.byte_order_habits import Habit
    from holdfast.discovery.segments import Value
    from holdfast.discovery.sunspec import SunSpec
    from holdfast.types import Area

SINGLE_BITS = 64
"""Ranges of more bits become tags of many bits each."""

MAX_BITS_PER_TAG = 256

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

REFUSED = (ILLEGAL_FUNCTION, *REFUSALS)
"""Exceptions of what a device does not have; after others, the next read may succeed."""


@dataclass
class Description:
    """What is known about one unit id of a device, so far."""

    unit: int
    survey: Survey
    identity: Identity = field(default_factory=Identity)
    """As `device_search` has found it."""
    sunspec: SunSpec | None = None
    reads: dict[tuple[Area, range], list[list[int]]] = field(default_factory=dict)
    """The contents of what one request has read, of every time."""
    unread: dict[tuple[Area, str], list[range]] = field(default_factory=dict)
    """Ranges that exist but that a later reading could not read, by the reason."""
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

    def read_sunspec(address: int, count: int) -> list[int]:
        most = survey.max_quantity or READ_LIMITS["holding_registers"]
        stop = address + count
        registers: list[int] = []
        # No device takes less than a header, which is not there if it is refused.
        for first in range(address, stop, most):
            block = address_search.Probe("holding_registers", first, min(most, stop - first))
            for _, content in address_search.read_in_parts(
                survey, read, block, len(sunspec.HEADER)
            ):
                if isinstance(content, ModbusError):
                    raise content
                registers += content
        return registers

    def search(area: Area, address: int, kind: str) -> None:
        content = read(area, address, kind)
        found.seen.setdefault(area, {}).update(enumerate(content, address))

    if any(each.area == "holding_registers" for each in survey.areas):
        found.sunspec = sunspec.find(read_sunspec, survey.span)
    address_search.run_sync(survey, search, progress)
    if progress is not None:
        progress(survey)
    blocks = [(each, block) for each, extent in _places(found) for block in each.blocks(extent)]
    for turn in range(reads):
        if turn and blocks:
            time.sleep(every)
        blocks = [
            (each, part) for each, block in blocks for part in _read_again(found, read, each, block)
        ]


def _read_again(
    found: Description, read: Callable[[Area, int, str], list[int]], each: AreaMap, block: range
) -> list[range]:
    """Reads a block, and keeps the contents. Returns the parts to read the next time: all but what
    the device has refused.
    """
    area = each.area
    probe = address_search.Probe(area, block.start, len(block))
    answers = list(address_search.read_in_parts(found.survey, read, probe, each.width))
    before = found.reads.pop((area, block), [])
    parts = []
    for probe, content in answers:
        part = range(probe.address, probe.address + probe.count)
        known = slice(part.start - block.start, part.stop - block.start)
        contents = [old[known] for old in before]
        if isinstance(content, ModbusError):
            ranges = found.unread.setdefault((area, str(content)), [])
            address_search.add_addresses(ranges, part.start, len(part))
        else:
            contents.append(content)
        if not (isinstance(content, ModbusException) and content.code in REFUSED):
            parts.append(part)
        if contents:
            found.reads[area, part] = contents
    return parts


def _places(found: Description) -> Iterator[tuple[AreaMap, range]]:
    """The ranges to describe, without those of SunSpec."""
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
                    yield each, part


def _without(
    found: Description, known: Iterable[tuple[Area, range]]
) -> Iterator[tuple[AreaMap, range]]:
    """What there is to describe, without what is known."""
    joined: dict[Area, list[range]] = {}
    for area, extent in known:
        address_search.add_addresses(joined.setdefault(area, []), extent.start, len(extent))
    for each, extent in _places(found):
        first = extent.start
        for other in joined.get(each.area, ()):
            if first < min(other.start, extent.stop):
                yield each, range(first, min(other.start, extent.stop))
            first = max(first, other.stop)
        if first < extent.stop:
            yield each, range(first, extent.stop)


def conclude(found: Description, now: float | None = None, seconds: float | None = None) -> None:
    """Infers the tags from what was read; from what the survey has seen, where it ended early.

    `now` is the time in seconds of Unix time. After `seconds`, and after an exception, the tags so
    far are there: `undescribed` has the other ranges.
    """
    end = None if seconds is None else time.monotonic() + seconds
    most = MAX_REGISTERS_AT_ONCE if end is None else MAX_REGISTERS_IN_A_HURRY
    unread = ((area, each) for (area, _), ranges in found.unread.items() for each in ranges)
    for each, extent in list(_without(found, (*found.reads, *unread))):
        for block in each.blocks(extent):
            found.reads[each.area, block] = [[found.seen[each.area][at] for at in block]]
    areas = [each.area for each in found.survey.areas]
    if found.sunspec is not None:
        [limit] = [each.limit for each in found.survey.areas if each.area == "holding_registers"]
        found.tags += sunspec_tags.tags_of(found.sunspec, limit)
    for whole in _joined(found):
        if whole.area in BIT_AREAS:
            found.tags += _bits(whole)
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
    """The ranges that were found and have no tags: they could not be read again, or `conclude`
    ended early.
    """
    tags = ((each.tag.area, range(each.tag.address, each.tag.end)) for each in found.tags)
    return ((each.area, extent) for each, extent in _without(found, tags))


@dataclass(frozen=True)
class _Piece:
    """Consecutive registers, either all of interest or all without content."""

    area: Area
    address: int
    reads: list[list[int]]
    limit: int
    """The most addresses that one request may be for."""
    is_empty: bool

    @property
    def stop(self) -> int:
        """The address behind the piece."""
        return self.address + len(self.reads[0])

    def part(self, first: int, stop: int) -> _Piece:
        """Some of the registers."""
        reads = [read[first:stop] for read in self.reads]
        return replace(self, address=self.address + first, reads=reads)


def _joined(found: Description) -> Iterator[_Piece]:
    """What was read, in ranges as long as possible, with the reads that are of a whole range."""
    areas = [each.area for each in found.survey.areas]
    limits = {each.area: each.limit for each in found.survey.areas}
    piece: _Piece | None = None
    for area, block in sorted(found.reads, key=lambda key: (areas.index(key[0]), key[1].start)):
        contents = found.reads[area, block]
        if piece is not None and (area, block.start) == (piece.area, piece.stop):
            del piece.reads[len(contents) :]
            for read, more in zip(piece.reads, contents, strict=False):
                read += more
            continue
        if piece is not None:
            yield piece
        reads = [[*read] for read in contents]
        piece = _Piece(area, block.start, reads, limits[area], is_empty=False)
    if piece is not None:
        yield piece


def _pieces(found: Description) -> Iterator[_Piece]:
    """The registers that were read, divided where many contain nothing."""
    maps = {each.area: each for each in found.survey.areas}
    for whole in _joined(found):
        if whole.area in BIT_AREAS:
            continue
        area = maps[whole.area]
        # A device that takes less at once may also refuse other reads than those of before.
        borders = [
            block.start - whole.address
            for of, block in found.reads
            if of == area.area and area.takes_less
        ]
        start = 0
        size = len(whole.reads[0])
        for first, stop in (*_empty(whole.reads, area.width), (size, size)):
            if start < first:
                yield whole.part(start, first)
            inside = sorted(each for each in borders if first < each < stop)
            for one, other in pairwise((first, *inside, stop)):
                if one < other:
                    yield replace(whole, is_empty=True).part(one, other)
            start = stop


def _empty(reads: list[list[int]], width: int) -> Iterator[tuple[int, int]]:
    """The runs of registers that contain nothing in any read, and begin and end a multiple of the
    width from the first register.
    """
    first = 0
    size = len(reads[0])
    while first < size:
        content = reads[0][first]
        stop = first
        if content in segments.FILL:
            while stop < size and all(read[stop] == content for read in reads):
                stop += 1
        if stop - first >= MIN_GAP_REGISTERS:
            yield first + -first % width, stop - stop % width
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
        for part in _parts(piece, value):
            known = sure
            if not any(part.found) or part.reasons == (segments.FILL_REASONS[0xFFFF],):
                known = min(sure, segments.NOTHING_KNOWN)
            yield _described(piece, part, min(known, MAX_CONFIDENCE))


def _parts(piece: _Piece, value: Value) -> Iterator[Value]:
    """A value, in parts that the device returns in one request. Only texts and arrays have any."""
    is_text = value.kind == "string"
    if value.registers <= piece.limit or not (is_text or SIZES[value.kind] == 1):
        yield value
        return
    for first in range(value.offset, value.stop, piece.limit):
        count = min(piece.limit, value.stop - first)
        kind = f"string:{2 * count}" if is_text else value.type
        # An array is shown by its first element.
        parts = [read[first : first + (count if is_text else 1)] for read in piece.reads]
        found = tuple(values.decode(part, kind, value.order) for part in parts)
        yield replace(value, type=kind, offset=first, registers=count, found=found)


def _filled(piece: _Piece) -> Iterator[DescribedTag]:
    """Registers that contain nothing, in tags of limited size."""
    content = piece.reads[0][0]
    size = len(piece.reads[0])
    for first in range(0, size, piece.limit):
        count = min(piece.limit, size - first)
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


def _bits(piece: _Piece) -> Iterator[DescribedTag]:
    total = len(piece.reads[0])
    size = 1 if total <= SINGLE_BITS else min(MAX_BITS_PER_TAG, piece.limit)
    for first in range(0, total, size):
        count = min(size, total - first)
        kind = "bool" if count == 1 else f"bool[{count}]"
        found = tuple(
            bool(read[first]) if count == 1 else [bool(bit) for bit in read[first : first + count]]
            for read in piece.reads
        )
        reasons = ("changes",) if any(each != found[0] for each in found) else ()
        address = piece.address + first
        tag = Tag(f"{SHORT_OF[piece.area]}_{address}", piece.area, address, kind)
        yield DescribedTag(tag, 1.0, found, reasons)


def _tag(
    area: Area, address: int, kind: str, order: str, confidence: float, reasons: Sequence[str]
) -> Tag:
    text = f"confidence {confidence:.2f}{': ' if reasons else ''}{', '.join(reasons)}"
    return Tag(f"{SHORT_OF[area]}_{address}", area, address, kind, order, description=text)
