"""Devices that the appliance communicates with too: their requests share one connection.

The appliance's poller owns these connections. A request waits for its turn there, and is not sent
if its caller gives up before. The gateway's own connections are in `pool`.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from holdfast.client.endpoint import endpoint
from holdfast.errors import (
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
)
from holdfast.gateway.broadcast import is_broadcast
from holdfast.gateway.shared_reads import READS
from holdfast.polling.calls import Calls

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast._core import Endpoint, Link, Poller, Request
    from holdfast.client.url import NetworkTarget


MAX_ENDPOINTS = 256
"""The endpoints that are kept."""

MIN_TIMEOUT_S = 0.001
"""The shortest timeout of a request."""


MOVED = "connection lost: the next one would lead to an address that is not allowed"


class QueueFull(Exception):
    """Too many requests wait for the connection."""


class Elsewhere(Exception):
    """The connection leads to an address that the request may not reach. Nothing was sent."""


class ApplianceLinks:
    """The links of an appliance, in one event loop."""

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self._held: dict[NetworkTarget, tuple[Link, float]] = {}
        """Links, and when they were used. While one is held, its connection stays open."""
        self._endpoints: dict[NetworkTarget, tuple[Endpoint, float]] = {}
        """Endpoints with TLS, and when their files were read."""
        self._calls: Calls | None = None
        self._opening = asyncio.Lock()

    async def turns(
        self, target: NetworkTarget, timeout: float, peers: tuple[str, ...] | None
    ) -> Turns | None:
        """Returns the turns of requests within `timeout` seconds from now.

        If the host is a name, `peers` are the addresses that the requests may reach.
        Returns `None` if the appliance does not use the address, or with other certificates.
        """
        if target.transport == "tls" and target not in self._endpoints:
            # The gateway's own connection reports unusable files.
            with contextlib.suppress(OSError, ValueError):
                made = await asyncio.to_thread(endpoint, target)
                self._endpoints[target] = made, time.monotonic()
        link = self._link(target)
        if link is None:
            return None
        if self._calls is None:
            async with self._opening:
                self._calls = self._calls or await Calls.opened()
        return _LinkTurns(target, self._calls, link, timeout, peers)

    def knows(self, target: NetworkTarget) -> bool:
        """Returns whether the appliance uses this address."""
        return self._known_link(target) is not None

    def forget_unused(self, latest: float) -> None:
        """Releases the links that were last used before `latest`, or that a reload has removed."""
        for target, (_, used) in list(self._held.items()):
            is_judged = target.transport != "tls" or target in self._endpoints
            if used < latest or (is_judged and not self.knows(target)):
                del self._held[target]
        for target, (_, read_at) in list(self._endpoints.items()):
            if read_at < latest:
                del self._endpoints[target]

    def close(self) -> None:
        """Ends all calls."""
        if self._calls is not None:
            self._calls.close()
        self._held.clear()

    def _link(self, target: NetworkTarget) -> Link | None:
        link = self._known_link(target)  # A reload may have replaced the one that is held.
        if link is None:
            self._held.pop(target, None)
        else:
            self._held[target] = link, time.monotonic()
        return link

    def _known_link(self, target: NetworkTarget) -> Link | None:
        """Returns the link to a target that the appliance uses now."""
        if target.transport != "tls":
            return self._poller.link_if_used(_plain_endpoint(target))
        known = self._endpoints.get(target)
        return None if known is None else self._poller.link_if_used(known[0])


@lru_cache(MAX_ENDPOINTS)
def _plain_endpoint(target: NetworkTarget) -> Endpoint:
    """The endpoint of a target without TLS. Each request asks for its link."""
    return endpoint(target)


class Turns:
    """Sends the requests of one caller to a device, each when its turn comes."""

    late, longest_late = 0, 0.0
    """Required by `AsyncTransport`. The connection counts its late replies."""

    def __init__(self, target: NetworkTarget) -> None:
        self.target = target
        self.is_sent = False
        """Whether the device may have received a request."""
        self.check_write: Callable[[], None] | None = None
        """Raises if a write must not be sent any more."""

    def check(self, request: Request) -> None:
        """Called at the last moment before a request is sent. Raises what `check_write` raises."""
        if self.check_write is not None and request.pdu[0] not in READS:
            self.check_write()

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        """Sends a request when its turn comes. Raises the errors of a client.

        Raises also `QueueFull`, and `Elsewhere` unless an earlier request was sent.
        A `ConnectionLost` is of all requests of this caller: one before may have been sent.
        """
        raise NotImplementedError

    async def close(self) -> None:
        """Does nothing: the connection has other users."""


class _LinkTurns(Turns):
    """Turns on a link of the appliance, within `timeout` seconds from now."""

    def __init__(
        self,
        target: NetworkTarget,
        calls: Calls,
        link: Link,
        timeout: float,
        peers: tuple[str, ...] | None,
    ) -> None:
        super().__init__(target)
        self._calls = calls
        self._link = link
        self._peers = peers
        self._deadline = time.monotonic() + timeout

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        left = max(min(self._deadline - time.monotonic(), timeout), MIN_TIMEOUT_S)
        broadcast = is_broadcast(self.target.transport, unit)
        self.check(request)
        ticket = self._link.call(
            self._calls.caller, request, unit, left, broadcast=broadcast, peers=self._peers
        )
        if ticket is None:
            raise QueueFull
        answer = self._calls.result(ticket)
        try:
            sent, result = await answer
        except asyncio.CancelledError:
            self.is_sent |= self._calls.give_up(ticket, answer)
            raise
        if isinstance(result, PermissionError):
            if not (self.is_sent or sent):
                raise Elsewhere
            result = ConnectionLost(MOVED)
        if isinstance(result, ConnectionLost | RequestTimeout):
            sent = result.maybe_sent = self.is_sent or (sent and result.maybe_sent)
        self.is_sent |= sent
        if not isinstance(result, ModbusError):
            return result
        if isinstance(result, ModbusException) and broadcast:
            raise InvalidResponse(f"the peer answered a broadcast with {result}")
        raise result
