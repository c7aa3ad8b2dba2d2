"""Sessions with brokers, which outlive a connection, and in this process also an adapter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from holdfast.config.models.root import MappedTag
    from holdfast.config.models.services import MappingConfig, SubscriptionConfig

Meaning: TypeAlias = "tuple[SubscriptionConfig | MappingConfig, MappedTag | None]"
"""The settings of a topic, and the tag that its values are for."""

Known: TypeAlias = "dict[str, tuple[Meaning, int]]"
"""Topics that a session has: what they mean, and the quality of service that was granted."""

SESSION_EXPIRY_S = 3600
"""Seconds that the broker keeps the session while this client is disconnected. MQTT 5 only."""


@dataclass
class Session:
    """What the process knows of a session with a broker."""

    unreleased: set[int] = field(default_factory=set)
    """Packet identifiers of QoS 2."""
    known: Known = field(default_factory=dict)
    """Its topics. A retained message that was written is not written again when the adapter is
    replaced: another writer may have written a newer value since."""


_SESSIONS: dict[tuple[str, str], Session] = {}
"""By broker and client id. A session goes on when the adapter is replaced by another one, after a
reload or a failure."""


def session_of(broker: str, client_id: str) -> Session:
    """The session of a client with a broker, which the broker may have too."""
    return _SESSIONS.setdefault((broker, client_id), Session())
