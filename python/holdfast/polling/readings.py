"""What polls bring: the values of tags, and how they are read from the blocks of a poll."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.polling.faults import fault_text, is_exception
from holdfast.protocol import READ_BITS, READ_REGISTERS
from holdfast.tags.decoding import Places, Undecoded, assembled, decoder, value_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from holdfast.tags import Tag
    from holdfast.tags.decoding import Decoder
    from holdfast.types import Area, PolledBlock


class Reading(NamedTuple):
    """The value of a tag, or why there is none."""

    device: str
    tag: Tag
    value: Any
    """`None` if the device did not answer, or has no value."""
    time: float
    """When the device answered, in seconds since 1970."""
    fault: int = 0
    """0 if the device answered; otherwise the code in `holdfast.polling.faults`."""
    undecoded: str | None = None
    """Why the registers can't be converted to a value, if they can't."""

    @property
    def name(self) -> str:
        """The name of the tag."""
        return self.tag.name

    @property
    def error(self) -> str | None:
        """Why there is no value; `None` if there is one, or the device says that it has none."""
        return fault_text(self.fault) if self.fault else self.undecoded


class DevicePoll(NamedTuple):
    """The readings of one poll of one device, one for each of its tags."""

    device: str
    readings: list[Reading]

    @property
    def is_standby(self) -> bool:
        """Whether another node polls the device now: then there are no readings."""
        return not self.readings

    @property
    def has_answered(self) -> bool:
        """Whether the device answered at least once, be it with an exception."""
        return any(not reading.fault or is_exception(reading.fault) for reading in self.readings)


class Batch:
    """Polls that have come since the last batch. Iterates over all readings."""

    def __init__(self, polls: list[DevicePoll]) -> None:
        self.polls = polls

    def __iter__(self) -> Iterator[Reading]:
        for poll in self.polls:
            yield from poll.readings

    def __len__(self) -> int:
        return sum(len(poll.readings) for poll in self.polls)

    def rows(self) -> list[dict[str, Any]]:
        """The readings as rows, for `pandas.DataFrame` and `csv.DictWriter`."""
        return [
            {
                "time": reading.time,
                "device": reading.device,
                "tag": reading.tag.name,
                "value": reading.value,
                "unit": reading.tag.unit,
                "error": reading.error,
            }
            for reading in self
        ]


MAX_BLOCKS = 4096
"""Blocks whose decoders are kept. A device has few, but a plan that changes makes others."""


class Reader:
    """Reads the tags of one device from the blocks of its polls."""

    def __init__(
        self,
        device: str,
        tags: Iterable[Tag],
        max_registers: int = READ_REGISTERS,
        max_bits: int = READ_BITS,
    ) -> None:
        self.device = device
        self.tags = tuple(tags)
        self.named = {tag.name: tag for tag in self.tags}
        """The tags, by name."""
        each = ((tag.name, tag.parts(max_registers, max_bits)) for tag in self.tags)
        self.cut = {name: parts for name, parts in each if len(parts) > 1}
        """The parts of the tags that exceed a request, by name."""
        self._places = Places(self.tags)
        self._blocks: dict[tuple[Area, int, int], tuple[Sequence[Tag], Decoder | None]] = {}

    @property
    def fields(self) -> dict[tuple[Area, int, int], list[str]]:
        """What has to be read: areas, addresses and counts, each with the names of its tags."""
        found: dict[tuple[Area, int, int], list[str]] = {}
        for tag in self.tags:
            for part in self.cut.get(tag.name) or (tag.span,):
                found.setdefault((tag.area, part.start, len(part)), []).append(tag.name)
        return found

    def poll(self, blocks: Sequence[PolledBlock]) -> DevicePoll:
        """The readings of one poll, one for each tag, in the order of the tags.

        A poll ends with the first request that is not answered: its fault is that of all tags that
        are missing.
        """
        found: dict[str, Reading] = {}
        for area, address, count, data, fault, time in blocks:
            tags, decode = self._inside(area, address, count)
            if data is None or decode is None:
                for tag in tags:
                    # A block that overlaps this one may have its value.
                    found.setdefault(tag.name, Reading(self.device, tag, None, time, fault))
                continue
            for tag, raw in zip(tags, decode(data), strict=True):
                found[tag.name] = self._reading(tag, raw, time)
        if len(found) < len(self.tags):
            found.update(self._others(found, blocks))
        return DevicePoll(self.device, [found[tag.name] for tag in self.tags if tag.name in found])

    def _others(
        self, found: Mapping[str, Reading], blocks: Sequence[PolledBlock]
    ) -> Iterator[tuple[str, Reading]]:
        """The readings of tags that no block has whole."""
        for tag in self.tags:
            if tag.name in found:
                continue
            pieces = [block for block in blocks if block[0] == tag.area and _overlap(tag, block)]
            read = [(piece[1], piece[2], piece[3]) for piece in pieces if piece[3] is not None]
            data = assembled(tag, self.cut.get(tag.name) or [tag.span], read)
            faulty = [block for block in [*pieces, *blocks[-1:]] if block[4]]
            if data is not None:
                yield tag.name, self._reading(tag, value_of(tag, data, tag.address), pieces[-1][5])
            elif faulty:
                *_, fault, time = faulty[0]
                yield tag.name, Reading(self.device, tag, None, time, fault)
            elif blocks:
                # A request of at most `max_registers` may be too short for a number, or not reach
                # from a value to its scale.
                whole = "whole" if tag.source is None else "together with its scale"
                why = f"no request has read it {whole}"
                yield tag.name, Reading(self.device, tag, None, blocks[-1][5], 0, why)

    def _inside(self, area: Area, address: int, count: int) -> tuple[Sequence[Tag], Decoder | None]:
        key = (area, address, count)
        known = self._blocks.get(key)
        if known is None:
            if len(self._blocks) >= MAX_BLOCKS:
                self._blocks.clear()
            tags = self._places.inside(*key)
            known = self._blocks[key] = (tags, decoder(tags, address, count) if tags else None)
        return known

    def _reading(self, tag: Tag, raw: Any, time: float) -> Reading:
        if type(raw) is Undecoded:
            return Reading(self.device, tag, None, time, 0, raw.error)
        return Reading(self.device, tag, tag.value(raw), time)


def _overlap(tag: Tag, block: PolledBlock) -> bool:
    return block[1] < tag.span.stop and tag.span.start < block[1] + block[2]
