"""Subscribes to the topics of the adapter, and avoids repeated retained messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from paho.mqtt.subscribeoptions import SubscribeOptions

from holdfast.config.models.services import SubscriptionConfig

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Set

    from paho.mqtt.reasoncodes import ReasonCode

    from holdfast.adapters.mqtt.connection import BrokerConnection
    from holdfast.adapters.mqtt.sessions import Known, Meaning
    from holdfast.config.models.root import MappedTag
    from holdfast.config.models.services import MappingConfig, MqttConfig


@dataclass
class _Topic:
    """A subscription and the quality of service that the broker granted."""

    entry: SubscriptionConfig | MappingConfig
    granted: int | None = None
    """In this connection."""


class Subscriptions:
    """The topics of one adapter, over all its connections."""

    def __init__(
        self,
        settings: MqttConfig,
        mapped: Mapping[str, MappedTag],
        known: Known,
        restored: Set[str],
    ) -> None:
        """`known` is what the process knows of the session, also from adapters before this one.

        `restored` are the memories that had their contents before the process began.
        """
        self._mapped, self._known, self._restored = mapped, known, restored
        self._is_version_5 = settings.version == "5"
        self._topics = [_Topic(entry) for entry in settings.subscriptions]
        self._topics += [_Topic(entry) for entry in settings.map]
        self._unanswered: dict[int, _Topic] = {}
        """By the packet identifier of SUBSCRIBE."""

    def status(self) -> list[dict[str, object]]:
        """Each topic with the quality of service that was requested and granted."""
        return [
            {"topic": topic.entry.topic, "qos": topic.entry.qos, "granted": topic.granted}
            for topic in self._topics
        ]

    def begin(self, link: BrokerConnection, *, is_resumed: bool) -> None:
        """Subscribes over a new connection, in a session that is new or resumed."""
        self._unanswered.clear()
        if not is_resumed:
            self._known.clear()
        for topic in self._topics:
            self._subscribe(link, topic)

    def _subscribe(self, link: BrokerConnection, topic: _Topic) -> None:
        """Subscribes, so that no retained message comes twice in a session.

        With MQTT 5, an option of SUBSCRIBE prevents that. With MQTT 3.1.1, topics are skipped that
        this process has already subscribed to in this session. A process begins with empty memories
        and needs retained messages, except for memories that are restored: others may have written
        newer values since.
        """
        entry = topic.entry
        before, granted = self._known.get(entry.topic, (None, None))
        # One that was changed is new: its values go elsewhere.
        known = granted if before == self._meaning(entry) else None
        if self._is_version_5:
            # With QoS 0, the broker keeps nothing for the session of a process that has ended.
            is_kept = before is None and entry.qos > 0 and self._is_restored(entry)
            retained = (
                SubscribeOptions.RETAIN_SEND_IF_NEW_SUB
                if known is not None or is_kept
                else SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
            )
            options = SubscribeOptions(qos=entry.qos, retainHandling=retained)
            identifier = link.subscribe(entry.topic, options=options)[1]
        elif known is None:
            identifier = link.subscribe(entry.topic, entry.qos)[1]
        else:
            topic.granted = known
            return
        if identifier is not None:
            self._unanswered[identifier] = topic

    def answered(self, identifier: int, reasons: Iterable[ReasonCode]) -> str | None:
        """Handles the answer to SUBSCRIBE. Returns the topic if the broker refused it."""
        topic = self._unanswered.pop(identifier, None)
        reason = next(iter(reasons), None)
        if topic is None or reason is None:
            return None
        topic.granted = None if reason.is_failure else reason.value
        self._known.pop(topic.entry.topic, None)
        if topic.granted is not None:
            self._known[topic.entry.topic] = (self._meaning(topic.entry), topic.granted)
        return topic.entry.topic if reason.is_failure else None

    def _is_restored(self, entry: SubscriptionConfig | MappingConfig) -> bool:
        """Whether all memories of a topic are restored: others have only what messages write."""
        memories = entry.memories if isinstance(entry, SubscriptionConfig) else [entry.memory]
        return self._restored >= set(memories)

    def _meaning(self, entry: SubscriptionConfig | MappingConfig) -> Meaning:
        return entry, self._mapped.get(entry.topic)

    def ended(self) -> None:
        """Forgets what was granted in the connection that has ended."""
        for topic in self._topics:
            topic.granted = None
