"""Answers to messages with a response topic (MQTT 5, section 4.10).

Answers are best effort: they must neither delay later messages nor fill memory. An answer is
dropped and counted if too many packets are unsent, if it is larger than the broker accepts, or if
its topic is invalid or matches a subscription, so that the answer would come back as a message.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.adapters.mqtt.connection import BrokerConnection
    from holdfast.adapters.mqtt.inbox import Filters
    from holdfast.adapters.mqtt.plain_values import PlainValue
    from holdfast.net.mqtt.packets import Publish


MAX_WAITING_ANSWERS = 100
"""Limit of unsent packets, and of unacknowledged answers. Above it answers are dropped."""


class Answers:
    """Sends and counts answers."""

    def __init__(self, filters: Filters, values: Mapping[str, PlainValue]) -> None:
        self._filters, self._values = filters, values
        self.sent = 0
        self.dropped = 0

    def send(self, link: BrokerConnection, message: Publish, answer: Mapping[str, object]) -> None:
        """Answers a message, if it has a response topic."""
        if message.response_topic is None:
            return
        if self._try_send(link, message, answer):
            self.sent += 1
        else:
            self.dropped += 1

    def _is_ours(self, topic: str) -> bool:
        """Whether an answer would come back as a message."""
        return topic in self._values or self._filters.grant(topic) is not None

    def _try_send(
        self, link: BrokerConnection, message: Publish, answer: Mapping[str, object]
    ) -> bool:
        topic = message.answer_topic
        if topic is None or self._is_ours(topic):
            return False
        payload = msgspec.json.encode(answer)
        size = len(payload) + len(topic.encode()) + len(message.correlation or b"")
        if link.connection.unsent >= MAX_WAITING_ANSWERS or not link.takes(size):
            return False
        qos = min(message.qos, 1, link.most_qos)
        if qos and link.unacknowledged >= MAX_WAITING_ANSWERS:
            return False
        properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        properties.ContentType = "application/json"
        if message.correlation is not None:
            properties.CorrelationData = message.correlation
        link.answer(topic, payload, qos, properties)
        return True
