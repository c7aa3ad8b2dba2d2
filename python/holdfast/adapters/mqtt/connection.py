"""One connection to a broker: paho's client, but messages are received here.

- A message is acknowledged after it was written, with every quality of service. With QoS 2 paho
  sends PUBREC before it delivers the message, so a crash between the two would lose the message.
- A message that is `REFUSED_FOR_NOW` is not acknowledged, and ends the connection: the broker
  sends it again after a reconnect.
- The properties of a message are parsed here, in linear time.
- A packet over the size limit is not kept in memory while it arrives.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from holdfast.adapters.mqtt.inbox import MAX_PAYLOAD_BYTES
from holdfast.adapters.mqtt.sessions import SESSION_EXPIRY_S
from holdfast.ingest import REFUSED_FOR_NOW
from holdfast.net.mqtt.client import BrokerClient
from holdfast.net.mqtt.packet_splitter import PacketSplitter
from holdfast.net.mqtt.packets import MAX_HEAD_BYTES, acknowledgement, parse_publish

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from paho.mqtt.client import Client, MQTTMessageInfo
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

    from holdfast.adapters.mqtt.inbox import Inbox
    from holdfast.config.models.services import MqttConfig
    from holdfast.net.mqtt.packets import Publish
    from holdfast.net.mqtt.waiter import Waiter

MAX_UNSENT_PACKETS = 1000
"""Limit of unsent packets, mostly acknowledgements. Above it nothing is read from the broker."""

_MAX_UNACKNOWLEDGED = 20
"""Limit of answers that are sent and not acknowledged; further answers wait."""

JUST_NOW_S = 5.0
"""Seconds after an answer, in which a broker ends the connection if it forbids the topic."""

_READ_BYTES = 65_536

_PUBLISH, _PUBACK, _PUBREC, _PUBREL, _PUBCOMP, _PINGRESP = 0x30, 0x40, 0x50, 0x60, 0x70, 0xD0


class BrokerConnection(BrokerClient):
    """One connection, from dialing to its end. A reconnect creates a new object."""

    def __init__(
        self,
        settings: MqttConfig,
        waiter: Waiter,
        unreleased: set[int],
        inbox: Inbox,
        answer: Callable[[BrokerConnection, Publish, Mapping[str, object]], None],
    ) -> None:
        """`unreleased` are QoS 2 packet identifiers, kept from one connection to the next.

        `answer` is called for each message, after its acknowledgement.
        """
        super().__init__(settings, settings.client_id, waiter, session_expiry=SESSION_EXPIRY_S)
        self._inbox, self._unreleased, self._answer = inbox, unreleased, answer
        self._largest_sent: int | None = None
        self.most_qos = 1
        """The highest quality of service that the broker accepts, at most 1."""
        self._packets = PacketSplitter(MAX_PAYLOAD_BYTES + MAX_HEAD_BYTES, MAX_HEAD_BYTES)
        self._alive_at = time.monotonic()
        self._arrived: Iterator[tuple[int, bytes | bytearray, int]] = iter(())
        """What was read and is not handled yet."""
        self._is_late = False
        """Whether there may be something in `_arrived`."""
        self._most_on_the_way = _MAX_UNACKNOWLEDGED
        self._on_the_way: set[int] = set()
        self._waiting: deque[tuple[str, bytes, Properties]] = deque()
        """Topic, payload and properties of answers that wait until others are acknowledged."""
        self._answered: tuple[str, float] | None = None
        """The topic of the last answer that was published, and when."""
        self.on_publish = self._send_waiting

    @property
    def may_read(self) -> bool:
        """Whether the broker has taken enough of what is sent to it."""
        return self.connection.unsent < MAX_UNSENT_PACKETS

    @property
    def pending(self) -> bool:
        """Whether `read_more` has something to do though nothing arrives."""
        return self.connection.error is not None or (self.may_read and self._is_late)

    def accepted(self, properties: Properties | None) -> None:
        """Applies the limits from the broker's CONNACK."""
        most: int = getattr(properties, "ReceiveMaximum", _MAX_UNACKNOWLEDGED)
        self._most_on_the_way = min(most, _MAX_UNACKNOWLEDGED)
        self._largest_sent = getattr(properties, "MaximumPacketSize", None)
        self.most_qos = min(getattr(properties, "MaximumQoS", 1), 1)

    def takes(self, size: int) -> bool:
        """Returns whether the broker accepts a message of this size, plus packet overhead."""
        return self._largest_sent is None or size + 64 <= self._largest_sent

    @property
    def unacknowledged(self) -> int:
        """Answers that wait for an acknowledgement, or for that of others."""
        return len(self._on_the_way) + len(self._waiting)

    @property
    def topic_answered_just_now(self) -> str | None:
        """The topic of an answer that was published only just; the broker may forbid it."""
        if self._answered is None or time.monotonic() > self._answered[1] + JUST_NOW_S:
            return None
        return self._answered[0]

    def answer(self, topic: str, payload: bytes, qos: int, properties: Properties) -> None:
        """Publishes a message, with QoS 1 when the broker has acknowledged others."""
        if not qos:
            self._publish_answer(topic, payload, 0, properties)
            return
        self._waiting.append((topic, payload, properties))
        self._send_waiting()

    def _send_waiting(
        self,
        _client: Client | None = None,
        _data: object = None,
        identifier: int = 0,
        _reason: ReasonCode | None = None,
        _properties: Properties | None = None,
    ) -> None:
        """Publishes answers that wait, after the acknowledgement of another."""
        self._on_the_way.discard(identifier)
        while self._waiting and len(self._on_the_way) < self._most_on_the_way:
            topic, payload, properties = self._waiting.popleft()
            sent = self._publish_answer(topic, payload, 1, properties)
            self._on_the_way.add(sent.mid)

    def _publish_answer(
        self, topic: str, payload: bytes, qos: int, properties: Properties
    ) -> MQTTMessageInfo:
        self._answered = topic, time.monotonic()
        return self.publish(topic, payload, qos, properties=properties)

    def read_more(self) -> None:
        """Reads and handles what has arrived, while the broker takes the answers."""
        if not self._is_late:
            data = self.connection.receive_from_broker(_READ_BYTES)
            self._arrived = self._packets.feed(data)
            if data:
                self._note_alive()
        self._is_late = True
        for first, body, size in self._arrived:
            self._handle(first, body, size)
            if not self.is_open or not self.may_read:
                return
        self._is_late = False
        if self.connection.error is not None:
            self.notice()

    def _note_alive(self) -> None:
        """Tells paho that the broker lives: its answer to a ping may be behind many messages."""
        now = time.monotonic()
        if now - self._alive_at >= self._settings.keep_alive / 4:
            self._alive_at = now
            self.pass_on(_PINGRESP, b"")

    def _handle(self, first: int, body: bytes | bytearray, size: int) -> None:
        """Handles a packet, whose body is cut if it is shorter than `size`."""
        if first & 0xF0 == _PUBLISH:
            self._take(first, body, size)
        elif first & 0xF0 == _PUBREL:
            self._release(body)
        else:
            self.pass_on(first, body)

    def _take(self, first: int, body: bytes | bytearray, size: int) -> None:
        """Writes the message of a PUBLISH packet, and acknowledges it."""
        try:
            message = parse_publish(first, body, size, five=self._five)
        except ValueError as error:
            self.end(f"malformed message: {error}")
            return
        is_known = message.qos == 2 and message.identifier in self._unreleased
        result = {} if is_known else self._inbox.take(message, stale=_staleness(message))
        if message.qos and result.get("reason") in REFUSED_FOR_NOW:
            self.end(str(result["detail"]))
            return
        # Before the answer: if the broker closes the connection because of that, it does not
        # deliver the message again.
        if message.qos == 1:
            self.connection.send_to_broker(acknowledgement(_PUBACK, message.identifier))
        elif message.qos == 2:
            self._unreleased.add(message.identifier)
            self.connection.send_to_broker(acknowledgement(_PUBREC, message.identifier))
        if not is_known and self.connection.error is None:
            self._answer(self, message, result)

    def _release(self, body: bytes | bytearray) -> None:
        """Answers a PUBREL packet. Raises `ValueError`."""
        if len(body) < 2:
            raise ValueError("a PUBREL packet without identifier")
        identifier = int.from_bytes(body[:2])
        self._unreleased.discard(identifier)
        self.connection.send_to_broker(acknowledgement(_PUBCOMP, identifier))


def _staleness(message: Publish) -> str | None:
    """Why a message may be old.

    `None` if nothing says so: what the broker has kept for a session looks like any new message.
    """
    if message.is_retained:
        return "the message is retained, so its command may be old"
    if message.is_repeated:
        return "the broker delivers the message again, and its command may be carried out already"
    return None
