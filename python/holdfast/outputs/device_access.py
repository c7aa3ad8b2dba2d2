"""What an output may know of the devices, and what it may ask them to do."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, NamedTuple, Protocol

from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence, Set

    from holdfast.polling import Reading
    from holdfast.tags import Tag


class NotWritten(Exception):
    """A write that was refused, or that the device did not confirm.

    `reason` is a word for programs, `detail` a message for people.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason, self.detail = reason, detail


class DeviceInfo(NamedTuple):
    """What is known of a device besides its values."""

    address: str
    """Its URL without options, and its unit id."""
    host: str | None
    """Its host; `None` on a serial line."""
    maker: str | None
    model: str | None
    version: str | None


class Site(Protocol):
    """The devices that an output publishes. Thread-safe."""

    @property
    def revision(self) -> int:
        """Changes with the tags of any device, and with `devices`."""

    @property
    def answering_revision(self) -> int:
        """Changes when a device stops answering, or answers again."""

    def tags(self) -> Mapping[str, Sequence[Tag]]:
        """The tags of each device."""

    def devices(self) -> Mapping[str, DeviceInfo]:
        """What is known of each device."""

    def answering(self) -> Mapping[str, bool]:
        """Whether each device answers: none does before its first poll."""

    @property
    def standby(self) -> Set[str]:
        """The devices that another node polls, which has newer values of them."""

    def latest(self) -> Sequence[Reading]:
        """The last reading of each tag."""

    @property
    def retained(self) -> dict[tuple[str, str], str]:
        """The name of the output that has published a topic, by broker and topic, until it was
        removed there. All outputs share it, so that one goes on after a reload where another ended.
        """

    def refresh(self) -> None:
        """Has the last value of each tag published again, and those not known yet once they are."""

    def write(
        self,
        device: str,
        tag: str,
        text: str,
        peer: str,
        done: Callable[[NotWritten | None], None],
        *,
        states: bool = True,
    ) -> None:
        """Writes a value, as text or, with `states`, as a name. Does not wait for the device.

        `done` is called with the outcome, by another thread. Raises `NotWritten` if nothing was
        sent. `peer` is where the command came from, for the audit log.
        """


class CommandOutcomes:
    """Logs and counts the outcomes of commands of an output. Thread-safe."""

    def __init__(self, output: str) -> None:
        self._output = output
        self._lock = threading.Lock()
        self.written = self.refused = self.ignored = 0

    def ended(self, device: str, tag: str, refused: NotWritten | None) -> None:
        """Notes that a command was carried out, or refused."""
        fields = {"output": self._output, "device": device, "tag": tag}
        with self._lock:
            self.written += refused is None
            self.refused += refused is not None
        if refused is None:
            log_lines.write(logging.INFO, "output_command_written", **fields)
        else:
            log_lines.refused(
                "output_command_refused", kind=self._output, **fields, reason=refused.reason
            )

    def ignore(self, topic: str, reason: str) -> None:
        """Notes a message that is no valid command."""
        with self._lock:
            self.ignored += 1
        fields = {"output": self._output, "topic": topic, "reason": reason}
        log_lines.refused("output_command_ignored", kind=self._output, **fields)
