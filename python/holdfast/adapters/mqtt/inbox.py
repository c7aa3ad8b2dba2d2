"""Handles a message: the memory access writes it, or it is refused.

Its grant is that of the first subscription whose filter matches the topic, or of the topic itself
if it has plain values, such as 21.5. Only the topic decides, not the subscription identifier that a
broker may send. So the result is the same with every MQTT version, and with brokers that deliver a
message once for each matching filter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from paho.mqtt.matcher import MQTTMatcher

from holdfast.adapters.mqtt.plain_values import BadValue, throttle_of_bad_values
from holdfast.config.values.topics import without_share
from holdfast.events import log_lines
from holdfast.ingest import Grant, Refused
from holdfast.runtime.text import clip

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.adapters.mqtt.plain_values import PlainValue
    from holdfast.config.models.services import SubscriptionConfig
    from holdfast.ingest import MemoryAccess
    from holdfast.net.mqtt.packets import Publish

MAX_PAYLOAD_BYTES = 8 * 2**20
"""The largest payload of any message, in bytes."""

MAX_LOGGED_TOPIC_CHARS = 200
"""Characters of a topic that are logged."""

_NOBODY = Grant("no subscription", (), (), writes=False)


class Inbox:
    """Handles messages one by one. An error in one does not affect the next."""

    def __init__(
        self,
        memory_access: MemoryAccess,
        filters: Filters,
        values: Mapping[str, PlainValue],
        broker: str,
    ) -> None:
        """`values`: what the topics with plain values write."""
        self._memory_access = memory_access
        self._filters, self._values = filters, values
        self._broker = broker
        self.bad_values = throttle_of_bad_values(len(values))
        self.received = 0

    def take(self, message: Publish, *, stale: str | None = None) -> dict[str, object]:
        """Carries out a message. Returns the answer for its sender.

        `stale` says why the message may be old: then it writes to memory, but not to a device.
        """
        self.received += 1
        topic = message.topic
        shown = clip(topic, MAX_LOGGED_TOPIC_CHARS)
        peer = f"{self._broker} {shown}"
        value = self._values.get(topic)
        grant = value.grant if value else self._filters.grant(topic) or _NOBODY
        try:
            refused = _refused_unread(message, grant)
            if refused is None and value is not None:
                command = value.command(message.payload)
                return self._memory_access.write([command], grant, peer).answer()
            if refused is None:
                payload = message.payload
                return self._memory_access.ingest(payload, grant, peer, stale=stale).answer()
            self._memory_access.refuse(refused, grant.name, peer)
        except BadValue as error:
            refused = error
            self._memory_access.refuse(refused, grant.name, peer, throttle=self.bad_values)
        except Refused as error:
            refused = error
        except Exception:  # An error in one message must not stop the adapter.
            log_lines.problem("mqtt_message_failed", broker=self._broker, topic=shown)
            refused = Refused("internal_error", "the message could not be carried out")
            self._memory_access.refuse(refused, grant.name, peer)
        return refused.answer()


def _refused_unread(message: Publish, grant: Grant) -> Refused | None:
    if grant is _NOBODY:
        return Refused("not_granted", "no configured subscription matches this topic")
    if message.size > MAX_PAYLOAD_BYTES:
        return Refused("too_large", f"{message.size} bytes, allowed: {MAX_PAYLOAD_BYTES}")
    if message.problem is not None:
        return Refused("malformed", message.problem)
    return None


class Filters:
    """The topic filters of the subscriptions, in the order of the configuration."""

    def __init__(self, subscriptions: Sequence[SubscriptionConfig]) -> None:
        self._grants = [
            Grant(
                entry.topic,
                frozenset(entry.memories),
                frozenset(entry.areas),
                while_sealed=frozenset(entry.while_sealed or ()),
            )
            for entry in subscriptions
        ]
        self._matcher = MQTTMatcher()  # type: ignore[no-untyped-call]
        for place, entry in reversed(list(enumerate(subscriptions))):
            self._matcher[without_share(entry.topic)] = place

    def grant(self, topic: str) -> Grant | None:
        """Returns the grant for messages of this topic; `None` when no filter matches."""
        places = self._matcher.iter_match(topic)  # type: ignore[no-untyped-call]
        first: int | None = min(places, default=None)
        return None if first is None else self._grants[first]
