"""What an output may know of the devices, and what it may ask them to do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from holdfast.polling import Reading
    from holdfast.tags import Tag


class NotWritten(Exception):
    """A write that was refused, or that the device did not confirm.

    `reason` is a word for programs, `detail` a message for people.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason, self.detail = reason, detail


class Site(Protocol):
    """The devices that an output publishes. Thread-safe."""

    @property
    def revision(self) -> int:
        """Changes with the tags of any device."""

    @property
    def answers(self) -> int:
        """Changes when a device stops to answer, or answers again."""

    def tags(self) -> Mapping[str, Sequence[Tag]]:
        """The tags of each device."""

    def answering(self) -> Mapping[str, bool]:
        """Whether each device answers, as far as it is known."""

    def latest(self) -> Sequence[Reading]:
        """The last reading of each tag."""

    def refresh(self) -> None:
        """Has the next value of each tag published, also if it is unchanged."""

    def write(
        self,
        device: str,
        tag: str,
        text: str,
        peer: str,
        done: Callable[[NotWritten | None], None],
    ) -> None:
        """Writes a value, as text or as the name of a state. Does not wait for the device.

        `done` is called with the outcome, by another thread. Raises `NotWritten` if nothing was
        sent. `peer` is where the command came from, for the audit log.
        """
