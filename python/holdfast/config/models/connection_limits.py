"""How many connections a server over TCP has, and how long they may be idle."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from holdfast.config.models.base import Model
from holdfast.config.values.scalars import Connections, Duration, DurationOrZero
from holdfast.server.options import DEFAULTS, STREAM_DEFAULTS

FEW = 16
"""So many connections from one address are not limited by default."""


def per_source(data: dict[str, Any]) -> int:
    """Leaves room for others: silent connections from one address can't take all places.

    A listener for few connections often has a single client, or a gateway in front of all.
    """
    most: int = data["max_connections"]
    return max((most + 1) // 2, min(most, FEW))


def handshakes(max_connections: int) -> int:
    """The most connections that are not authenticated yet, beside `max_connections`.

    A listener for few clients has room for strangers too, who must not displace a client's
    handshake.
    """
    return max(STREAM_DEFAULTS["max_handshakes"], max_connections)


class ConnectionLimits(Model):
    """Limits of all servers over TCP connections."""

    max_connections: Connections = DEFAULTS["max_connections"]
    """Maximum number of open connections."""
    max_connections_per_source: Connections | None = Field(default_factory=per_source)
    """Maximum number of open connections from one address; null: unlimited. Default: half of
    max_connections, but at least 16."""
    when_full: Literal["refuse", "evict"] = DEFAULTS["when_full"]
    """At the limit: refuse closes the new connection, evict the connection idle longest."""
    idle_timeout: DurationOrZero = DEFAULTS["idle_timeout"]
    """Seconds without a request after which a connection is closed; 0: unlimited."""
    request_timeout: Duration = DEFAULTS["request_timeout"]
    """Seconds from the first byte of a request to its last."""
