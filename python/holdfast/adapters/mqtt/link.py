"""One connection to a broker: paho's client with four changes.

- A message is acknowledged after it was written, with every quality of service. With QoS 2 paho
  sends PUBREC before it delivers the message, so a crash between the two would lose the message.
- A message that a memory can't keep at the moment is not acknowledged, and the connection ends.
- The properties of a message are parsed here, in linear time.
- A packet over the size limit is not kept in memory while it arrives.

Methods that begin with an underscore override methods of paho.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from paho.mqtt.enums import MQTTErrorCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from holdfast.adapters.mqtt.inbox import MAX_BYTES
from holdfast.ingest import KEEPING
from holdfast.mqtt.client import BrokerClient
from holdfast.mqtt.packets import MAX_PROPERTIES, parse_publish

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Mapping

    from paho.mqtt.properties import Properties

    from holdfast.adapters.mqtt.inbox import Inbox
    from holdfast.config import MappingConfig, MqttConfig, SubscriptionConfig
    from holdfast.mqtt.packets import Publish

SESSION_EXPIRY = 3600
"""Seconds that the broker keeps the session while this client is disconnected. MQTT 5 only."""

MAX_WAITING = 100
"""Limit of unsent packets. Above it answers are dropped."""

MAX_UNSENT = 1000
"""Limit of unsent packets, mostly acknowledgements. Above it nothing is read from the broker."""

_MAX_ON_THE_WAY = 20
"""Limit of answers that are sent and not acknowledged; further answers wait."""

_KEPT = MAX_PROPERTIES + 2**17
"""Bytes kept of a packet over the size limit: enough for everything before the payload."""

_LARGEST = MAX_BYTES + _KEPT


class BrokerConnection(BrokerClient):
    """One connection, from dialing to its end. A reconnect creates a new object."""

    def __init__(
        self,
        settings: MqttConfig,
        password: bytes | None,
        dial: Callable[[], socket.socket],
        unreleased: set[int],
        inbox: Inbox,
        answer: Callable[[BrokerConnection, Publish, Mapping[str, object]], None],
    ) -> None:
        """`unreleased` are QoS 2 packet identifiers, kept from one connection to the next.

        `answer` is called for each message, after its acknowledgement.
        """
        super().__init__(
            settings, settings.client_id, password, dial, session_expiry=SESSION_EXPIRY
        )
        self._unreleased = unreleased
        self._inbox = inbox
        self._answer = answer
        self._largest_sent: int | None = None
        self.most_qos = 1
        """The highest quality of service that the broker accepts, at most 1."""
        self.max_queued_messages = MAX_WAITING

    def accepted(self, properties: Properties | None) -> None:
        """Applies the limits from the broker's CONNACK."""
        self.on_log = None
        most: int = getattr(properties, "ReceiveMaximum", _MAX_ON_THE_WAY)
        self._max_inflight_messages = min(most, _MAX_ON_THE_WAY)
        self._largest_sent = getattr(properties, "MaximumPacketSize", None)
        self.most_qos = min(getattr(properties, "MaximumQoS", 1), 1)

    def ask_for(
        self, subscription: SubscriptionConfig | MappingConfig, *, again: bool
    ) -> int | None:
        """Sends SUBSCRIBE and returns its packet identifier, `None` when it could not be sent.

        With `again`, the broker does not send retained messages a second time (MQTT 5).
        """
        if not self._five:
            return self.subscribe(subscription.topic, subscription.qos)[1]
        options = SubscribeOptions(
            qos=subscription.qos,
            retainHandling=(
                SubscribeOptions.RETAIN_SEND_IF_NEW_SUB
                if again
                else SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
            ),
        )
        return self.subscribe(subscription.topic, options=options)[1]

    def takes(self, size: int) -> bool:
        """Returns whether the broker accepts a message of this size, plus packet overhead."""
        return self._largest_sent is None or size + 64 <= self._largest_sent

    def _packet_read(self) -> MQTTErrorCode:
        code = super()._packet_read()
        if self._in_packet["remaining_length"] > _LARGEST:
            del self._in_packet["packet"][_KEPT:]
        return code

    def _handle_publish(self) -> MQTTErrorCode:
        packet = self._in_packet
        try:
            message = parse_publish(
                packet["command"], packet["packet"], packet["remaining_length"], five=self._five
            )
        except ValueError as error:
            self.trouble = f"malformed message: {error}"
            return MQTTErrorCode.MQTT_ERR_PROTOCOL
        if message.qos == 2 and message.identifier in self._unreleased:
            return self._send_pubrec(message.identifier)
        result = self._inbox.take(message)
        if message.qos and result.get("reason") in KEEPING:
            # Without an acknowledgement, the broker sends the message again after a reconnect.
            self.trouble = str(result["detail"])
            return MQTTErrorCode.MQTT_ERR_CONN_LOST
        code = MQTTErrorCode.MQTT_ERR_SUCCESS
        if message.qos == 1:
            code = self._send_puback(message.identifier)
        elif message.qos == 2:
            self._unreleased.add(message.identifier)
            code = self._send_pubrec(message.identifier)
        # The answer follows the acknowledgement: if the broker closes the connection because of
        # the answer, it does not deliver the message again.
        if code == MQTTErrorCode.MQTT_ERR_SUCCESS:
            self._answer(self, message, result)
        return code

    def _send_pubcomp(self, mid: int) -> MQTTErrorCode:
        self._unreleased.discard(mid)
        return super()._send_pubcomp(mid)
