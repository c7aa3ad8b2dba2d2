"""Tracks tags between readings: their last values, how old these are, and what changed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.errors import ModbusException
from holdfast.values import ConversionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.client.tag_reading import Error, Reading
    from holdfast.tags import Tag


@dataclass
class Tracked:
    """The last value of a tag."""

    tag: Tag
    value: Any = None
    was_read: bool = False
    """Whether there is a value; it is older than the last reading if there is an error."""
    at: float = 0.0
    """When the value was read."""
    error: Error | None = None
    """Why the last reading has no value."""
    changed: int | None = None
    """The number of the reading that changed the value; `None` if none did."""


@dataclass(frozen=True)
class TagChange:
    """A tag whose value or error changed."""

    tag: Tag
    was: Any
    now: Any
    error: Error | None


class TagTracker:
    """Compares readings of tags."""

    def __init__(self, tags: Sequence[Tag]) -> None:
        self.tracked = [Tracked(tag) for tag in tags]
        self.readings = 0
        self.errors = 0
        """Readings in which the device did not answer at all."""
        self.error: Error | None = None
        """Why no tag of the last reading has a value."""

    def update(self, moment: float, readings: Sequence[Reading]) -> list[TagChange]:
        """Adds a reading. Returns the changes since the reading before."""
        self.readings += 1
        changes: list[TagChange] = []
        for tracked, reading in zip(self.tracked, readings, strict=True):
            change = self._note(tracked, reading, moment)
            if change is not None:
                changes.append(change)
        self.error = common_error(readings)
        self.errors += self.error is not None
        return changes

    def age(self, tracked: Tracked) -> int | None:
        """How many readings ago the value of a tag changed; `None` if never."""
        return None if tracked.changed is None else self.readings - tracked.changed

    def _note(self, tracked: Tracked, reading: Reading, moment: float) -> TagChange | None:
        before, tracked.error = tracked.error, reading.error
        if reading.error is not None:
            # Only a new text is news to the reader: an error object is new in every reading.
            if str(before) == str(reading.error):
                return None
            return TagChange(reading.tag, tracked.value, None, reading.error)
        was, is_first = tracked.value, not tracked.was_read
        is_changed = (was, type(was)) != (reading.value, type(reading.value))
        tracked.value, tracked.at, tracked.was_read = reading.value, moment, True
        if is_changed and not is_first:
            tracked.changed = self.readings
        if not is_first and not is_changed and before is None:
            return None
        return TagChange(reading.tag, was, reading.value, None)


def common_error(readings: Sequence[Reading]) -> Error | None:
    """The error of a device that answered nothing; `None` if it answered anything."""
    for each in readings:
        if each.error is None or isinstance(each.error, ModbusException | ConversionError):
            return None
    return readings[0].error
