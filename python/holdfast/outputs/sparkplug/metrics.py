"""The metrics of a device: what births and data of its tags are."""

from __future__ import annotations

import struct
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.outputs.sparkplug.datatypes import INT32, STRING, Datatype, datatype_of
from holdfast.outputs.tag_meaning import meaning_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from holdfast.polling import Reading
    from holdfast.tags import Tag

GOOD, BAD = 192, 0
"""Quality codes of the specification."""


UNFIT = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, struct.error)
"""Errors of a value that is not of the type of its metric."""


class Entry(NamedTuple):
    """A metric: a tag, or one item of it."""

    device: str
    tag: Tag
    item: int | None
    name: str
    alias: int
    datatype: Datatype


class DeviceMetrics:
    """The metrics of one device, and what a host knows of them. For one thread."""

    def __init__(self, device: str, tags: Sequence[Tag], *, always_typed: bool) -> None:
        self.device = device
        self._always_typed = always_typed
        self._tags = {tag.name: tag for tag in tags}
        self._entries: dict[str, list[Entry]] = {}
        self.by_name: dict[str, Entry] = {}
        """The metrics by name. This and `by_alias` are for all threads."""
        self.by_alias: dict[int, Entry] = {}
        self._births: dict[str, float | None] = {}
        """When the tags had their values of the last birth, if they had any."""
        self._next_number = 0
        """The readings before this number waited at the last birth, and were not newer than it."""
        self._bad: set[str] = set()

    def birth(
        self,
        payload: Any,
        latest: Mapping[str, Reading],
        aliases: Iterator[int],
        next_number: int,
    ) -> None:
        """Adds all metrics with their current values, and with new aliases.

        `next_number` is from before `latest`: what came between the two is sent once more.
        """
        self._bad.clear()
        self._next_number = next_number
        tags = self._tags.values()
        self._entries = {tag.name: _entries(self.device, tag, aliases) for tag in tags}
        every = [entry for entries in self._entries.values() for entry in entries]
        self.by_name = {entry.name: entry for entry in every}
        self.by_alias = {entry.alias: entry for entry in every}
        for name, entries in self._entries.items():
            reading = latest.get(name)
            if reading is not None and not self._is_of_same_meaning(reading):
                reading = None
            at = time.time() if reading is None else reading.time
            self._births[name] = None if reading is None else at
            for entry in entries:
                metric = payload.metrics.add(
                    name=entry.name,
                    alias=entry.alias,
                    timestamp=int(at * 1000),
                    datatype=entry.datatype.number,
                )
                has_value = _fill(metric, entry, None if reading is None else reading.value)
                if not has_value:
                    self._bad.add(entry.name)
                _property(metric, "Quality", INT32, GOOD if has_value else BAD)
                if entry.tag.unit:
                    _property(metric, "engUnit", STRING, entry.tag.unit)

    def is_known(self, reading: Reading, number: int) -> bool:
        """Whether the birth had this reading, or there is no metric for it any more."""
        name = reading.tag.name
        if name not in self._entries:
            return True
        return number < self._next_number and self._births[name] == reading.time

    def add(self, payload: Any, reading: Reading, number: int) -> bool:
        """Adds the metrics of a reading.

        Returns whether the reading fits: it may have waited since before the tag was changed.
        """
        name = reading.tag.name
        if not self._is_of_same_meaning(reading):
            return False
        # A host stores what is historical, and does not show it as current: after an outage, the
        # birth has the newest values, and those that waited follow. Their order shows it: the clock
        # may have been set.
        is_historical = number < self._next_number
        entries, first = self._entries[name], len(payload.metrics)
        try:
            have_values = [_fill(payload.metrics.add(), entry, reading.value) for entry in entries]
        except UNFIT:
            del payload.metrics[first:]
            return False
        metrics = payload.metrics[first:]
        for metric, entry, has_value in zip(metrics, entries, have_values, strict=True):
            metric.alias, metric.timestamp = entry.alias, int(reading.time * 1000)
            if self._always_typed:
                metric.datatype = entry.datatype.number
            if is_historical:
                metric.is_historical = True
                if not has_value:
                    _property(metric, "Quality", INT32, BAD)
            elif has_value is (entry.name in self._bad):
                _property(metric, "Quality", INT32, GOOD if has_value else BAD)
                (self._bad.discard if has_value else self._bad.add)(entry.name)
        return True

    def _is_of_same_meaning(self, reading: Reading) -> bool:
        tag, current = reading.tag, self._tags[reading.tag.name]
        return reading.value is None or tag is current or meaning_of(tag) == meaning_of(current)


def _entries(device: str, tag: Tag, aliases: Iterator[int]) -> list[Entry]:
    datatype, by_item = datatype_of(tag)
    items: list[int | None] = [None]
    if by_item:
        items = list(range(tag.of_type.count or 0))
    names = [tag.name if item is None else f"{tag.name}/{item}" for item in items]
    return [
        Entry(device, tag, item, name, next(aliases), datatype)
        for item, name in zip(items, names, strict=True)
    ]


def _fill(metric: Any, entry: Entry, value: Any) -> bool:
    """Puts a value into a metric. Returns whether there is one."""
    if entry.item is not None and value is not None:
        value = value[entry.item]
    if value is None:
        metric.is_null = True
        return False
    setattr(metric, entry.datatype.field, entry.datatype.packed(value))
    return True


def _property(metric: Any, key: str, kind: int, value: int | str) -> None:
    metric.properties.keys.append(key)
    made = metric.properties.values.add(type=kind)
    if isinstance(value, str):
        made.string_value = value
    else:
        made.int_value = value
