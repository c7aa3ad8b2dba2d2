"""Which grant a message has: that of the first subscription whose filter its topic matches.

It is the topic alone that decides, not what a broker says of how it found the message: so it is the
same with every version of MQTT, and whether a broker delivers a message once or once for each
filter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from paho.mqtt.matcher import MQTTMatcher

from holdfast.ingest import Grant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config import SubscriptionConfig


class Filters:
    """The filters of a configuration, in its order."""

    def __init__(self, subscriptions: Sequence[SubscriptionConfig]) -> None:
        self._grants = [
            Grant(entry.topic, frozenset(entry.memories), frozenset(entry.areas))
            for entry in subscriptions
        ]
        self._matcher = MQTTMatcher()  # type: ignore[no-untyped-call]
        for place, entry in reversed(list(enumerate(subscriptions))):
            self._matcher[_without_share(entry.topic)] = place

    def grant(self, topic: str) -> Grant | None:
        """What a message of this topic may do; `None` when no filter matches it."""
        places = self._matcher.iter_match(topic)  # type: ignore[no-untyped-call]
        first: int | None = min(places, default=None)
        return None if first is None else self._grants[first]


def _without_share(topic: str) -> str:
    """`$share/group/filter` shares the messages of `filter` among the clients of a group."""
    share, _, rest = topic.partition("/")
    group, _, shared = rest.partition("/")
    return shared if share == "$share" and group and shared else topic
