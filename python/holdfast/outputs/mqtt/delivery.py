"""Messages to publish, and whether the broker has confirmed them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from holdfast.net.mqtt.packets import head

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

MAX_IN_FLIGHT = {"5": 1000, "3.1.1": 100}
"""Messages that are sent and not confirmed, by the version of MQTT, unless the broker allows fewer.
MQTT 3.1.1 has no way to tell."""

NO_PROPERTIES = b"\0"
"""The properties of a message without any, in MQTT 5."""


class Message(NamedTuple):
    """A message."""

    topic: bytes
    """As in a packet: its length in two bytes, then UTF-8."""
    payload: bytes
    retain: bool = False
    properties: bytes = NO_PROPERTIES


def packed_topic(topic: str) -> bytes:
    """A topic, as in a packet."""
    data = topic.encode()
    return len(data).to_bytes(2) + data


def unpacked_topic(packed: bytes) -> str:
    """The text of a `packed_topic`, which begins with its length."""
    return packed[2:].decode()


def packed(
    messages: Iterable[Message], identifiers: Iterable[int], *, qos: int, five: bool
) -> bytes:
    """PUBLISH packets, one after another."""
    out: list[bytes] = []
    heads = (0x30 | qos << 1, 0x31 | qos << 1)
    for (topic, payload, retain, properties), identifier in zip(messages, identifiers, strict=True):
        middle = identifier.to_bytes(2) if qos else b""
        if five:
            middle += properties
        size = len(topic) + len(middle) + len(payload)
        if size < 128:
            out += (bytes((heads[retain], size)), topic, middle, payload)
        else:
            out += (head(heads[retain], size), topic, middle, payload)
    return b"".join(out)


def size_of(message: Message) -> int:
    """The most bytes that the packet of a message has."""
    return 7 + len(message.topic) + len(message.payload) + len(message.properties)


class Delivery:
    """Messages on their way to the broker, in their order. For the thread of the connection."""

    def __init__(self, messages: Sequence[Message]) -> None:
        self.messages = messages
        self.sent = 0
        """How many were sent."""
        self.confirmed = 0
        """How many were confirmed, without a gap; read by other threads."""
        self._early: set[int] = set()

    @property
    def is_done(self) -> bool:
        """Whether all were confirmed."""
        return self.confirmed >= len(self.messages)

    def confirm(self, index: int) -> None:
        """Notes the confirmation of one message. A broker may confirm in another order."""
        if index != self.confirmed:
            self._early.add(index)
            return
        index += 1
        while self._early and index in self._early:
            self._early.discard(index)
            index += 1
        self.confirmed = index
