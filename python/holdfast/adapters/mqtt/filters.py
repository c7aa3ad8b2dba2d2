"""Finds the grant of a message: the grant of the first subscription whose filter matches the topic.

Only the topic decides, not the subscription identifier that a broker may send. So the result is the
same with every MQTT version, and with brokers that deliver a message once for each matching filter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from paho.mqtt.matcher import MQTTMatcher

from holdfast.ingest import Grant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config import SubscriptionConfig


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
            self._matcher[_without_share(entry.topic)] = place

    def grant(self, topic: str) -> Grant | None:
        """Returns the grant for messages of this topic; `None` when no filter matches."""
        places = self._matcher.iter_match(topic)  # type: ignore[no-untyped-call]
        first: int | None = min(places, default=None)
        return None if first is None else self._grants[first]


def _without_share(topic: str) -> str:
    """Returns the filter of a shared subscription, `$share/group/filter`; other filters as is."""
    share, _, rest = topic.partition("/")
    group, _, shared = rest.partition("/")
    return shared if share == "$share" and group and shared else topic
