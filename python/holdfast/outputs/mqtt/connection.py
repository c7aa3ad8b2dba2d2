"""One connection to a broker, for many messages.

- Many messages are sent with one call, and many confirmations read with one.
- A packet over the size limit is not kept in memory while it arrives.
- paho does the rest: CONNECT, SUBSCRIBE and DISCONNECT.

All methods are for the thread that serves the connection.
"""

from __future__ import annotations

import logging
import socket
from collections import deque
from itertools import islice
from math import inf
from typing import TYPE_CHECKING, Any

from paho.mqtt.enums import MQTTErrorCode
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from holdfast.events import log_lines
from holdfast.net.addresses import joined
from holdfast.net.mqtt.client import BrokerClient
from holdfast.net.mqtt.packet_splitter import PacketSplitter
from holdfast.net.mqtt.packets import MAX_HEAD_BYTES, acknowledgement, parse_publish
from holdfast.outputs.mqtt.delivery import MAX_IN_FLIGHT, Message, packed, size_of
from holdfast.outputs.mqtt.pings import PING_INTERVAL_S, Pings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from paho.mqtt.client import Client
    from paho.mqtt.properties import Properties

    from holdfast.config.models.services import BrokerConfig
    from holdfast.net.mqtt.packets import Publish
    from holdfast.net.mqtt.waiter import Waiter
    from holdfast.outputs.mqtt.delivery import Delivery

FIRST_IDENTIFIER, LAST_IDENTIFIER = 5000, 65535
"""Packet identifiers of messages. paho counts those of subscriptions from 1."""

MAX_PAYLOAD_BYTES = 65_536
"""Bytes of the payload of a command, which is short. One with more is refused."""

MAX_TOPICS_PER_SUBSCRIBE = 8
"""Topics in one SUBSCRIBE packet: AWS IoT Core ends connections that send more."""

PUBLISH, PUBACK, PINGRESP = 0x30, 0x40, 0xD0
_PING = bytes((0xC0, 0))

QUOTA_EXCEEDED = 0x97
READ_BYTES = 262_144
QUICK_ACK: int | None = getattr(socket, "TCP_QUICKACK", None)
"""An option that only Linux has, and that holds for a short time."""


class Connection(BrokerClient):
    """One connection. `on_command` is called for each message, and `on_refused` for each one that
    the broker did not accept, and won't later, with the reason.
    """

    def __init__(
        self,
        settings: BrokerConfig,
        client_id: str,
        waiter: Waiter,
        on_command: Callable[[Publish], None],
        on_refused: Callable[[Message, str], None],
        *,
        qos: int,
        takes_commands: bool,
        confirms_by_ping: bool,
    ) -> None:
        """`takes_commands`: messages are commands, and must not be late.

        `confirms_by_ping`: with a quality of service of 0, messages count as confirmed when the
        broker has answered a ping that follows them; otherwise, when they are written.
        """
        super().__init__(settings, client_id, waiter, session_expiry=0)
        self._on_command, self._on_refused = on_command, on_refused
        self._qos, self._takes_commands = qos, takes_commands
        self._confirms_by_ping = confirms_by_ping
        self._max_in_flight = MAX_IN_FLIGHT[settings.version]
        self._largest: int | None = None
        self._retains = True
        self._packets = PacketSplitter(MAX_PAYLOAD_BYTES + MAX_HEAD_BYTES, MAX_HEAD_BYTES)
        self._subscribing: dict[int, Sequence[str]] = {}
        self.on_subscribe = self._on_subscribed
        self._waiting: deque[Delivery] = deque()
        self._in_flight: dict[int, tuple[Delivery, int]] = {}
        self._written: list[Delivery] = []
        self._pinged: list[Delivery] = []
        """What the answer to the ping that is on its way confirms."""
        self._pings = Pings()
        self._next = FIRST_IDENTIFIER

    def accepted(self, properties: Properties | None) -> None:
        """Applies the limits from the broker's CONNACK."""
        self._max_in_flight = min(
            getattr(properties, "ReceiveMaximum", self._max_in_flight), self._max_in_flight
        )
        self._pings = Pings()
        self._largest = getattr(properties, "MaximumPacketSize", None)
        self._retains = bool(getattr(properties, "RetainAvailable", 1))
        self._qos = min(getattr(properties, "MaximumQoS", self._qos), self._qos)

    def publish_all(self, delivery: Delivery) -> None:
        """Publishes messages after those that wait."""
        self._waiting.append(delivery)

    def ask_for(self, topics: Sequence[str], *, retained: bool) -> None:
        """Subscribes to topics. With MQTT 5, retained messages come only if they are wanted, and
        those of this client never.
        """
        handling = (
            SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
            if retained
            else SubscribeOptions.RETAIN_DO_NOT_SEND
        )
        options = SubscribeOptions(qos=1, noLocal=True, retainHandling=handling)
        how: Any = options if self._five else 1
        for at in range(0, len(topics), MAX_TOPICS_PER_SUBSCRIBE):
            some = topics[at : at + MAX_TOPICS_PER_SUBSCRIBE]
            identifier = self.subscribe([(topic, how) for topic in some])[1]
            if identifier is not None:
                self._subscribing[identifier] = some

    def _on_subscribed(
        self,
        _client: Client,
        _data: object,
        identifier: int,
        reasons: list[ReasonCode],
        _properties: Properties | None,
    ) -> None:
        """Logs which subscriptions the broker refused."""
        for topic, reason in zip(self._subscribing.pop(identifier, ()), reasons, strict=False):
            if reason.is_failure:
                log_lines.write(
                    logging.ERROR,
                    "mqtt_subscription_refused",
                    broker=joined(self._settings.host, self._settings.port),
                    topic=topic,
                    reason=str(reason),
                )

    def send_more(self) -> bool:
        """Sends waiting messages, as many as the broker may have. Returns whether some are done."""
        news = False
        while self._waiting and len(self._in_flight) < self._max_in_flight:
            delivery = self._waiting[0]
            news |= self._send(delivery, self._max_in_flight - len(self._in_flight))
            if delivery.sent == len(delivery.messages):
                self._waiting.popleft()
        if self._written and self._confirms_by_ping:
            if not self._pings.is_waiting:
                self._ping()
        elif self._written and not self.connection.unsent:
            news = self._confirm(self._written)
        return news

    def ping_if_due(self) -> None:
        """Pings after the keep-alive time, and much more often while commands are taken. Ends the
        connection if the broker does not answer within the keep-alive time.
        """
        if not (self.is_accepted and self.is_open):
            return
        seconds = self._pings.age()
        keep_alive = self.keepalive or inf  # The broker may have set it to 0, which is none.
        if not self._pings.is_waiting:
            if seconds >= min(keep_alive, PING_INTERVAL_S if self._takes_commands else inf):
                self._ping()
        elif seconds >= keep_alive:
            self.end(f"the broker did not answer a ping within {keep_alive} s")

    def _ping(self) -> None:
        if self._confirms_by_ping:
            self._pinged, self._written = self._written, []
        self._pings.sent()
        self.connection.send_to_broker(_PING)

    @staticmethod
    def _confirm(deliveries: list[Delivery]) -> bool:
        """Confirms and removes whole deliveries. Returns whether there were some."""
        for delivery in deliveries:
            delivery.confirmed = len(delivery.messages)
        found = bool(deliveries)
        deliveries.clear()
        return found

    def _send(self, delivery: Delivery, room: int) -> bool:
        """Sends the next messages. Returns whether some were refused."""
        first = delivery.sent
        some = delivery.messages[first : first + room]
        delivery.sent += len(some)
        if not self._retains:
            some = [Message(topic, payload, False, more) for topic, payload, _, more in some]
        places = list(range(first, delivery.sent))
        large = [place for place in places if not self._fits(delivery.messages[place])]
        for place in large:
            reason = f"it has more than the {self._largest} bytes that are allowed"
            self._refused(delivery, place, reason)
        if large:
            places = [place for place in places if place not in large]
            some = [some[place - first] for place in places]
        identifiers = [0] * len(some)
        if self._qos:
            identifiers = list(islice(self._identifiers(), len(some)))
            self._in_flight.update(
                zip(identifiers, [(delivery, place) for place in places], strict=True)
            )
        elif delivery.sent == len(delivery.messages):
            self._written.append(delivery)
        if some:
            data = packed(some, identifiers, qos=self._qos, five=self._five)
            self.connection.send_to_broker(data)
        return bool(large)

    def _fits(self, message: Message) -> bool:
        return self._largest is None or size_of(message) <= self._largest

    def _identifiers(self) -> Iterator[int]:
        while True:
            identifier = self._next
            self._next = identifier + 1 if identifier < LAST_IDENTIFIER else FIRST_IDENTIFIER
            if identifier not in self._in_flight:
                yield identifier

    def read_more(self) -> bool:
        """Reads what has arrived. Returns whether some deliveries are done."""
        connection = self.connection
        data = connection.receive_from_broker(READ_BYTES)
        if connection.error is not None:
            is_closed = isinstance(connection.error, EOFError)
            lost = "" if is_closed else "the connection was lost: "
            self.end(f"{lost}{connection.error}")
            return False
        if QUICK_ACK is not None:
            # A broker that writes each confirmation by itself waits for an acknowledgement by TCP
            # between them, which the system would send 40 ms later.
            connection.connection.setsockopt(socket.IPPROTO_TCP, QUICK_ACK, 1)
        news = False
        for first, body, size in self._packets.feed(data):
            if first == PUBACK:
                news |= self._confirmed(body)
            elif first & 0xF0 == PUBLISH:
                self._received(first, body, size)
            elif first == PINGRESP and self._pings.is_waiting:
                self._pings.answered()
                news |= self._confirm(self._pinged)
            elif self.pass_on(first, body) != MQTTErrorCode.MQTT_ERR_SUCCESS:
                self.end(self.end_reason or "the broker sent a malformed packet")
            if not connection.is_open:
                break
        return news

    def _confirmed(self, body: bytes | bytearray) -> bool:
        """Notes a confirmation. Returns whether the delivery is done."""
        known = self._in_flight.pop(int.from_bytes(body[:2]), None)
        if known is None:
            return False
        delivery, index = known
        code = body[2] if len(body) > 2 else 0
        if code < 128:
            delivery.confirm(index)
            return delivery.is_done
        reason = str(ReasonCode(PacketTypes.PUBACK, identifier=code))
        if code == QUOTA_EXCEEDED:
            self.end(f"the broker did not accept a message: {reason}")
            return False
        self._refused(delivery, index, reason)
        return delivery.is_done

    def _refused(self, delivery: Delivery, index: int, reason: str) -> None:
        self._on_refused(delivery.messages[index], reason)
        delivery.confirm(index)

    def _received(self, first: int, body: bytes | bytearray, size: int) -> None:
        message = parse_publish(first, body, size, five=self._five)
        if self._takes_commands:
            message = message._replace(lateness=self._pings.lateness())
        if message.qos == 1:
            self.connection.send_to_broker(acknowledgement(PUBACK, message.identifier))
        elif message.qos == 2:
            raise ValueError("a message with a quality of service that was not requested")
        self._on_command(message)
