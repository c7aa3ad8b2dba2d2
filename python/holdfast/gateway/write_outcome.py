"""What became of a write: the word for it in the log, and whether the device may have written.

The outcome in a security event: `holdfast.events.ecs_categories`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from holdfast.errors import ModbusException
from holdfast.net.http.requests import BadRequest

if TYPE_CHECKING:
    from holdfast.gateway.device import RequestedDevice

HEADER = "Holdfast-Maybe-Written"
"""Of responses to writes that were not carried out, or may not have been."""


class WriteOutcome(NamedTuple):
    """The outcome of a write that has ended."""

    word: str
    maybe_written: bool

    @property
    def header(self) -> tuple[bytes, bytes]:
        """`HEADER` and its value."""
        return HEADER.lower().encode(), str(self.maybe_written).lower().encode()


def outcome(device: RequestedDevice, error: BaseException | None) -> WriteOutcome:
    """Returns the outcome of a write that has ended with this error, or without one."""
    if isinstance(error, BadRequest) and error.reason != "stopping":
        return WriteOutcome("refused", device.maybe_sent)
    if not device.maybe_sent:
        return WriteOutcome("not sent", False)
    if isinstance(error, ModbusException):
        return WriteOutcome(f"exception {error.code:02X}", error.maybe_executed)
    if error is not None:
        return WriteOutcome("failed", True)
    return WriteOutcome("sent" if device.is_broadcast else "done", True)
