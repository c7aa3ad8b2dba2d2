"""A pool of connections to devices. All requests to one device share one connection.

In an appliance, devices that it uses itself are asked over its own connections (`sharing`).

A connection is opened when it is needed. It is closed when it is idle for some time, and when the
last request on it had no response, because the state of the connection is then unknown. Where
replies have no transaction ids, its client stays: it knows which ones may come on the next
connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field, replace
from math import inf
from typing import TYPE_CHECKING, TypeVar

from holdfast.client import Client
from holdfast.client.endpoint import check_files
from holdfast.client.url import IN_FLIGHT, NetworkTarget
from holdfast.errors import ConnectionLost, ModbusException
from holdfast.net.tls import NO_FILES

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from typing import Protocol

    from holdfast.gateway.egress import Route
    from holdfast.gateway.sharing import Shared
    from holdfast.net.tls import Tls

    class Dial(Protocol):
        """Creates clients. A client connects when it is first used."""

        def __call__(self, target: NetworkTarget, *, timeout: float, in_flight: int) -> Client:
            """Returns a client for an address.

            Raises `OSError` and `ValueError` for TLS files that can't be used.
            """
            ...


Result = TypeVar("Result")

CHECK_INTERVAL = 0.5
"""Seconds between checks for idle connections."""

MAX_LATENESS = 10.0
"""Seconds after its timeout in which a late reply may come."""


class Full(Exception):
    """All connections of the pool are in use."""


class Unusable(Exception):
    """The TLS files, which were valid at the start, can't be used any more."""


def dial(target: NetworkTarget, *, timeout: float, in_flight: int) -> Client:
    """Returns a client for an address.

    Raises `OSError` and `ValueError` for TLS files that can't be used.
    """
    query = f"?{target.tls.query}" if target.transport == "tls" else ""
    return Client(f"{target}{query}", timeout=timeout, max_in_flight=in_flight)


@dataclass
class _Entry:
    """A client and its users."""

    client: Client
    timeout: float
    turns: asyncio.Semaphore
    users: int = 0
    """The number of requests that use the client or wait for it."""
    active: int = 0
    """The number of requests that use the client."""
    used: float = field(default_factory=time.monotonic)
    doubtful: bool = False
    """Whether the last request had no response."""
    needed: float = -inf
    """Until then, late replies may come that only this client knows."""


class Pool:
    """At most `most` clients, by target. A client is closed after `idle` seconds without use.

    Over TCP and TLS, at most `in_flight` requests to a device are pending at once; over other
    transports one. Further requests wait. `longest` is the longest timeout of a request in seconds.
    """

    def __init__(
        self,
        *,
        most: int,
        in_flight: int,
        idle: float,
        longest: float,
        tls: Tls = NO_FILES,
        dial: Dial = dial,
        shared: Shared | None = None,
    ) -> None:
        self._most = most
        self._in_flight = in_flight
        self._idle = idle
        self._longest = longest
        self._tls = tls
        self._dial = dial
        self._shared = shared
        self._entries: dict[NetworkTarget, _Entry] = {}
        self._keeper: asyncio.Task[None] | None = None

    def __len__(self) -> int:
        return len(self._entries)

    async def run(
        self,
        route: Route,
        timeout: float,
        call: Callable[[Client], Awaitable[Result]],
    ) -> Result:
        """Runs a call on the connection to a device, trying its addresses in turn.

        The connection is that of the appliance, if it uses the host or one of the addresses.

        `timeout` is in seconds; the caller must cancel the call when it expires. Raises `Full`,
        `Unusable`, `ValueError` for an invalid certificate name, and the exceptions of the call.
        """
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep())
        tls = NO_FILES if route.name is None else replace(self._tls, name=route.name)
        keys = [NetworkTarget(route.transport, each, route.port, tls) for each in route.addresses]
        if self._shared is not None:
            hosts = dict.fromkeys((route.host, *route.addresses))
            for target in (NetworkTarget(route.transport, host, route.port, tls) for host in hosts):
                client = await self._shared.client(target, timeout)
                if client is not None:
                    return await call(client)
        keys.sort(key=lambda key: key not in self._entries)
        for key in keys[:-1]:
            try:
                return await self._run(key, timeout, call)
            except ConnectionLost as error:
                if error.maybe_sent:
                    raise
        return await self._run(keys[-1], timeout, call)

    async def _run(
        self,
        key: NetworkTarget,
        timeout: float,
        call: Callable[[Client], Awaitable[Result]],
    ) -> Result:
        entry = await self._entry(key, timeout)
        entry.users += 1
        try:
            async with entry.turns:
                entry.active += 1
                try:
                    await self._refresh(key, entry, timeout)
                    return await self._call(entry, call)
                finally:
                    entry.active -= 1
        finally:
            entry.users -= 1
            entry.used = time.monotonic()
            if entry.doubtful:
                entry.needed = entry.used + entry.timeout + MAX_LATENESS

    async def _call(self, entry: _Entry, call: Callable[[Client], Awaitable[Result]]) -> Result:
        """Runs a call, and updates the state of the connection."""
        entry.doubtful = True
        try:
            result = await call(entry.client)
        except ModbusException:
            entry.doubtful = False
            raise
        entry.doubtful = False
        return result

    async def _close_doubtful(self, entry: _Entry) -> None:
        """Closes the connection of a client that stays."""
        async with entry.turns:
            if entry.doubtful:
                entry.doubtful = False
                await entry.client.close()

    async def _entry(self, key: NetworkTarget, timeout: float) -> _Entry:
        if key not in self._entries:
            made = await self._client(key, timeout)
        entry = self._entries.get(key)  # Another request may have created it meanwhile.
        if entry is None:
            gone = self._pushed_out() if len(self._entries) >= self._most else None
            in_flight = self._in_flight if key.transport in IN_FLIGHT else 1
            entry = _Entry(*made, asyncio.Semaphore(in_flight))
            self._entries[key] = entry
            if gone is not None:
                entry.users += 1
                try:
                    await gone.client.close()
                finally:
                    entry.users -= 1
        return entry

    async def _client(self, key: NetworkTarget, timeout: float) -> tuple[Client, float]:
        """Returns a client and its timeout.

        Calls over TCP and TLS can be cancelled, so their client has the longest timeout. Other
        calls can't, so their client has the timeout of the request.
        """
        timeout = self._longest if key.transport in IN_FLIGHT else timeout
        if key.transport != "tls":
            return self._dial(key, timeout=timeout, in_flight=self._in_flight), timeout
        return await asyncio.to_thread(self._dial_tls, key, timeout), timeout

    def _dial_tls(self, key: NetworkTarget, timeout: float) -> Client:
        """Returns a client with TLS. Blocks, because it reads the TLS files."""
        try:
            return self._dial(key, timeout=timeout, in_flight=self._in_flight)
        except (OSError, ValueError):
            try:
                check_files(self._tls)
            except (OSError, ValueError) as error:
                raise Unusable(str(error)) from None
            raise

    async def _refresh(self, key: NetworkTarget, entry: _Entry, timeout: float) -> None:
        """Closes a connection that is in doubt, and sets the timeout; reads TLS files again."""
        if key.transport not in IN_FLIGHT:
            entry.client.timeout = entry.timeout = timeout
        if entry.active > 1 or not entry.doubtful:
            return
        made = entry.client
        if key.transport == "tls":
            made, _ = await self._client(key, timeout)
        if entry.active > 1:  # Another request uses it meanwhile.
            return
        old, entry.client = entry.client, made
        entry.doubtful = False
        await old.close()

    def _pushed_out(self) -> _Entry:
        """Removes the least recently used idle entry. Raises `Full` if all are in use."""
        free = [key for key, entry in self._entries.items() if entry.users == 0]
        if not free:
            raise Full
        return self._entries.pop(min(free, key=lambda key: self._entries[key].used))

    async def _keep(self) -> None:
        """Closes idle connections, and all connections at the end."""
        try:
            while True:
                await asyncio.sleep(CHECK_INTERVAL)
                await self._close_unused()
        finally:
            for entry in self._entries.values():
                with contextlib.suppress(Exception):
                    await entry.client.close()
            if self._shared is not None:
                self._shared.close()

    async def _close_unused(self) -> None:
        latest = time.monotonic() - self._idle
        if self._shared is not None:
            self._shared.forget_unused(latest)
        for key, entry in list(self._entries.items()):
            if entry.users > 0:
                continue
            is_needed = key.transport not in IN_FLIGHT and time.monotonic() < entry.needed
            if is_needed and not self._is_shared(key):
                await self._close_doubtful(entry)
            elif entry.doubtful or entry.used < latest or self._is_shared(key):
                del self._entries[key]
                await entry.client.close()

    def _is_shared(self, key: NetworkTarget) -> bool:
        """Returns whether the appliance has begun to use the device, which may accept no more."""
        return self._shared is not None and self._shared.knows(key)
