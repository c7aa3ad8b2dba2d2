"""The open connections of an HTTP host, and their limits.

At a limit, a connection that waits for its peer gives way to a new one, so that silent peers can't
lock the port. A connection whose request is being answered never gives way while its peer reads; an
event stream is such a request.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, NamedTuple, Protocol, TypeVar

if TYPE_CHECKING:
    from holdfast.net.addresses import Address
    from holdfast.types import WhenFull

TIMEOUT = 1.0
"""Seconds that a peer has to send a request, or to take a response, before it can be evicted."""


@dataclass(frozen=True)
class ConnectionLimits:
    """The limits on open connections, as in the configuration."""

    max_connections: int
    max_connections_per_source: int | None = None
    when_full: WhenFull = "refuse"


class Waiting(NamedTuple):
    """What a connection has been waiting for, and since when, in seconds of the event loop.

    The order of these tuples is the order in which connections are evicted.
    """

    in_request: bool
    """Whether it waits for the rest of a request, or for the peer to take a response."""
    since: float


class Held(Protocol):
    """An open connection."""

    def waiting(self) -> Waiting | None:
        """Returns what it waits for; `None` while the peer waits."""


Connection = TypeVar("Connection", bound=Held)


class Full(Exception):
    """A limit is reached, and no connection can be evicted."""


class Admission(Generic[Connection]):
    """The open connections of one host."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self._limits = limits
        self._held: dict[Connection, Address] = {}
        self._per_source: Counter[Address] = Counter()

    def admit(self, connection: Connection, source: Address, now: float) -> Connection | None:
        """Admits a connection. Returns the one that was evicted for it. Raises `Full`."""
        limits, evicted = self._limits, None
        most = limits.max_connections_per_source
        if most is not None and self._per_source[source] >= most:
            evicted = self._evict(source, now)
        elif len(self._held) >= limits.max_connections:
            evicted = self._evict(None, now)
        self._held[connection] = source
        self._per_source[source] += 1
        return evicted

    def release(self, connection: Connection) -> None:
        """Frees the place of a connection, if it has one."""
        source = self._held.pop(connection, None)
        if source is None:
            return
        self._per_source[source] -= 1
        if not self._per_source[source]:
            del self._per_source[source]

    def _evict(self, source: Address | None, now: float) -> Connection:
        """Frees the place that an idle peer has held longest, of one source or of all."""
        if self._limits.when_full == "refuse":
            raise Full
        candidates = [
            (waiting, connection)
            for connection, peer in self._held.items()
            if source in (None, peer) and (waiting := connection.waiting()) is not None
            if _may_go(waiting, now)
        ]
        if not candidates:
            raise Full
        _, evicted = min(candidates, key=lambda each: each[0])
        self.release(evicted)
        return evicted


def _may_go(waiting: Waiting, now: float) -> bool:
    return not waiting.in_request or now - waiting.since >= TIMEOUT
