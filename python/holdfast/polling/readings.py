"""What polls bring: the values of tags."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.faults import fault_text, is_exception

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.tags import Tag


class Reading(NamedTuple):
    """The value of a tag, or why there is none."""

    device: str
    tag: Tag
    value: Any
    """`None` if the device did not answer, or has no value."""
    time: float
    """When the device answered, in seconds since 1970."""
    fault: int = 0
    """0 if the device answered; otherwise the code in `holdfast.faults`."""
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
