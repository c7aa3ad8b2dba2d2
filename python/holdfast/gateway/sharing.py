"""Devices that the appliance communicates with too: their requests share one connection.

The appliance's poller owns these connections. A request waits for its turn there, and is not sent
if its caller gives up before. The gateway's own connections are in `pool`.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast._core import Caller
from holdfast.client import Client
from holdfast.client.endpoint import endpoint
from holdfast.errors import ConnectionLost, InvalidResponse, ModbusError, ModbusException

if TYPE_CHECKING:
    from holdfast._core import Endpoint, Link, Poller, Request
    from holdfast.client.url import NetworkTarget


SHORTEST = 0.001
"""The shortest timeout of a request, in seconds."""


class QueueFull(Exception):
    """Too many requests wait for the connection."""


@dataclass
class _Held:
    """A link that the gateway has used. While it is held, its connection stays open."""

    link: Link
    used: float = field(default_factory=time.monotonic)


class Shared:
    """The links of an appliance, in one event loop."""

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self._held: dict[NetworkTarget, _Held] = {}
        self._endpoints: dict[NetworkTarget, tuple[Endpoint, float]] = {}
        """Endpoints with TLS, and when their files were read."""
        self._calls: _Calls | None = None
        self._opening = asyncio.Lock()

    async def client(self, target: NetworkTarget, timeout: float) -> SharedClient | None:
        """Returns a client for requests within `timeout` seconds from now.

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
                self._calls = self._calls or await _Calls.opened()
        return SharedClient(target, _Turns(self._calls, link, timeout), timeout)

    def knows(self, target: NetworkTarget) -> bool:
        """Returns whether the appliance uses this address."""
        known = self._endpoint(target)
        return known is not None and self._poller.known_link(str(target), known) is not None

    def forget_unused(self, latest: float) -> None:
        """Releases the links that were last used before `latest`."""
        for target, held in list(self._held.items()):
            if held.used < latest:
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
        held = self._held.get(target)
        if held is None:
            known = self._endpoint(target)
            link = None if known is None else self._poller.known_link(str(target), known)
            if link is None:
                return None
            held = self._held[target] = _Held(link)
        held.used = time.monotonic()
        return held.link

    def _endpoint(self, target: NetworkTarget) -> Endpoint | None:
        if target.transport != "tls":
            return endpoint(target)
        known = self._endpoints.get(target)
        return None if known is None else known[0]


class SharedClient(Client):
    """A client whose connection belongs to the appliance.

    Its timeout covers all of its calls, with the waits for their turns.
    """

    def __init__(self, target: NetworkTarget, turns: _Turns, timeout: float) -> None:
        # It has no connection of its own, which the constructor of its base would create.
        self.target = target
        self.unit = 1
        self.timeout = timeout
        self._turns = turns
        self._transport = turns

    @property
    def is_sent(self) -> bool:
        """Whether the turn of a request has come, so that the device may have received it."""
        return self._turns.is_sent

    def broadcasts(self) -> None:
        """Makes calls end without a reply."""
        self._turns.broadcasts = True


class _Turns:
    """A link, for the calls of one client."""

    def __init__(self, calls: _Calls, link: Link, timeout: float) -> None:
        self._calls = calls
        self._link = link
        self._deadline = time.monotonic() + timeout
        self.is_sent = False
        self.broadcasts = False
        self.late, self.longest_late = 0, 0.0
        """The link drops late replies."""

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        """Sends a request when its turn comes. Raises `QueueFull` and the errors of a client."""
        left = max(min(self._deadline - time.monotonic(), timeout), SHORTEST)
        ticket = self._link.call(self._calls.caller, request, unit, left, broadcast=self.broadcasts)
        if ticket is None:
            raise QueueFull
        try:
            sent, result = await self._calls.result(ticket)
        except asyncio.CancelledError:
            self.is_sent |= self._calls.caller.withdraw(ticket)
            raise
        self.is_sent |= sent
        if not isinstance(result, ModbusError):
            return result
        if isinstance(result, ConnectionLost) and not sent:
            result.maybe_sent = False
        if isinstance(result, ModbusException) and self.broadcasts:
            raise InvalidResponse(f"the peer answered a broadcast with {result}")
        raise result

    async def close(self) -> None:
        """Does nothing: the connection belongs to the appliance."""


class _Calls(asyncio.Protocol):
    """The calls of an event loop. Receives a byte when results are ready."""

    def __init__(self, caller: Caller) -> None:
        self.caller = caller
        self._loop = asyncio.get_running_loop()
        self._futures: dict[int, asyncio.Future[tuple[bool, Any]]] = {}
        self._transport: asyncio.BaseTransport | None = None

    @staticmethod
    async def opened() -> _Calls:
        """Returns the calls of the running event loop. Raises `OSError` without a free socket."""
        caller = Caller()
        calls = _Calls(caller)
        wakes = socket.socket(fileno=caller.detach())
        await calls._loop.create_connection(lambda: calls, sock=wakes)
        return calls

    async def result(self, ticket: int) -> tuple[bool, Any]:
        """Waits for the end of a call: whether it was sent, and a result or a `ModbusError`."""
        future: asyncio.Future[tuple[bool, Any]] = self._loop.create_future()
        self._futures[ticket] = future
        try:
            return await future
        finally:
            del self._futures[ticket]

    def close(self) -> None:
        """Ends the wake-ups."""
        if self._transport is not None:
            self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def data_received(self, _data: bytes) -> None:
        for ticket, sent, result in self.caller.take():
            future = self._futures.get(ticket)
            if future is not None and not future.done():
                future.set_result((sent, result))
