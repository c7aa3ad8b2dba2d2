"""What is done with a message that a broker delivers: written, acknowledged, or left to the broker.

- A message is acknowledged after it was written, with every quality of service. With QoS 2 paho
  sends PUBREC before it delivers the message, so a crash between the two would lose the message.
- A message that a memory can't keep at the moment is not acknowledged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from holdfast.ingest import KEEPING
from holdfast.net.mqtt.packets import acknowledgement, parse_publish

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.adapters.mqtt.inbox import Inbox
    from holdfast.net.mqtt.packets import Publish

_PUBACK, _PUBREC, _PUBCOMP = 0x40, 0x50, 0x70


class NotTaken(Exception):
    """A message is malformed, or a memory can't keep it now. Without an acknowledgement, the broker
    sends it again after a reconnect.
    """


class Taken(NamedTuple):
    """A message, and what is sent for it."""

    acknowledgement: bytes
    """The packet, empty with QoS 0. It goes before an answer: if the broker closes the connection
    because of the answer, it does not deliver the message again.
    """
    message: Publish
    result: Mapping[str, object] | None
    """What became of it; `None` if it was taken before."""


class Deliveries:
    """The messages of one connection."""

    def __init__(self, inbox: Inbox, unreleased: set[int], *, five: bool) -> None:
        """`unreleased` are QoS 2 packet identifiers, kept from one connection to the next."""
        self._inbox = inbox
        self._unreleased = unreleased
        self._five = five

    def take(self, first: int, body: bytes | bytearray, size: int) -> Taken:
        """Writes the message of a PUBLISH packet, whose body is cut if it is shorter than `size`.

        Raises `NotTaken`.
        """
        try:
            message = parse_publish(first, body, size, five=self._five)
        except ValueError as error:
            raise NotTaken(f"malformed message: {error}") from error
        if message.qos == 2 and message.identifier in self._unreleased:
            return Taken(acknowledgement(_PUBREC, message.identifier), message, None)
        result = self._inbox.take(message, stale=_staleness(message))
        if message.qos and result.get("reason") in KEEPING:
            raise NotTaken(result["detail"])
        sent = b""
        if message.qos == 1:
            sent = acknowledgement(_PUBACK, message.identifier)
        elif message.qos == 2:
            self._unreleased.add(message.identifier)
            sent = acknowledgement(_PUBREC, message.identifier)
        return Taken(sent, message, result)

    def release(self, body: bytes | bytearray) -> bytes:
        """Returns the answer to a PUBREL packet. Raises `ValueError`."""
        if len(body) < 2:
            raise ValueError("a PUBREL packet without identifier")
        identifier = int.from_bytes(body[:2])
        self._unreleased.discard(identifier)
        return acknowledgement(_PUBCOMP, identifier)


def _staleness(message: Publish) -> str | None:
    """Why a message may be old.

    `None` if nothing says so: what the broker has kept for a session looks like any new message.
    """
    if message.is_retained:
        return "the message is retained, so its command may be old"
    if message.is_repeated:
        return "the broker delivers the message again, and its command may be carried out already"
    return None
