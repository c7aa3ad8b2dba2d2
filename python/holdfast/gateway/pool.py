"""Connections to devices, kept and shared: many requests to one device go down one of them.

A connection is made when it is needed. It is closed when nobody has used it for a while, and when
the last request on it was given up: what state the device is in is not known then.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar

from holdfast.client import Client
from holdfast.client.endpoint import check_files
from holdfast.client.target import IN_FLIGHT, NetworkTarget
from holdfast.errors import ConnectionLost, ModbusException
from holdfast.net.tls import NO_FILES

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from typing import Protocol

    from holdfast.gateway.egress import Route
    from holdfast.net.tls import Tls

    class Dial(Protocol):
        """Makes clients, which connect when they are first used."""

        def __call__(self, target: NetworkTarget, *, timeout: float, in_flight: int) -> Client:
            """The client of an address.

            Raises `OSError` and `ValueError` for what TLS can't use.
            """
            ...


Result = TypeVar("Result")

CHECK_INTERVAL = 0.5
"""Seconds between two looks for connections that nobody uses."""


class Full(Exception):
    """As many devices as there may be are talked to right now."""


class Unusable(Exception):
    """Files of TLS that could be used at the start, and can't now."""


def dial(target: NetworkTarget, *, timeout: float, in_flight: int) -> Client:
    """A client of an address. Raises `OSError` and `ValueError` for what TLS can't use."""
    query = f"?{target.tls.query}" if target.transport == "tls" else ""
    return Client(f"{target}{query}", timeout=timeout, max_in_flight=in_flight)


@dataclass
class _Entry:
    """A client and who uses it."""

    client: Client
    timeout: float
    turns: asyncio.Semaphore
    users: int = 0
    """Who use it or wait for their turn."""
    active: int = 0
    """Who have their turn."""
    used: float = field(default_factory=time.monotonic)
    proven: bool = False
    """Whether it has had a reply."""
    doubtful: bool = False
    """Whether the last request had no reply."""


class Pool:
    """Clients by their targets; `most` of them, each idle for `idle` seconds at most.

    Over TCP and TLS, `in_flight` requests are on their way to a device at once, otherwise one; more
    wait. `longest` is the most seconds that a request takes.
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
    ) -> None:
        self._most = most
        self._in_flight = in_flight
        self._idle = idle
        self._longest = longest
        self._tls = tls
        self._dial = dial
        self._entries: dict[NetworkTarget, _Entry] = {}
        self._keeper: asyncio.Task[None] | None = None

    def __len__(self) -> int:
        return len(self._entries)

    async def run(
        self,
        route: Route,
        timeout: float,
        call: Callable[[Client], Awaitable[Result]],
        *,
        repeat: bool,
    ) -> Result:
        """A call on the connection to a device; on the next address where none can be made.

        `timeout` is the time for it; it is for the caller to end it then. With `repeat` it is
        done again if the connection turns out to have ended since it was last used.
        Raises `Full`, `Unusable`, `ValueError` for a name that no certificate can have, and what
        the call raises.
        """
        tls = NO_FILES if route.name is None else replace(self._tls, name=route.name)
        keys = [NetworkTarget(route.transport, each, route.port, tls) for each in route.addresses]
        keys.sort(key=lambda key: key not in self._entries)
        for key in keys[:-1]:
            try:
                return await self._run(key, timeout, call, repeat=repeat)
            except ConnectionLost as error:
                if error.maybe_sent:
                    raise
        return await self._run(keys[-1], timeout, call, repeat=repeat)

    async def _run(
        self,
        key: NetworkTarget,
        timeout: float,
        call: Callable[[Client], Awaitable[Result]],
        *,
        repeat: bool,
    ) -> Result:
        entry = await self._entry(key, timeout)
        entry.users += 1
        try:
            async with entry.turns:
                entry.active += 1
                try:
                    await self._refresh(key, entry, timeout)
                    return await self._call(entry, call, repeat=repeat)
                finally:
                    entry.active -= 1
        finally:
            entry.users -= 1
            entry.used = time.monotonic()

    async def _call(
        self, entry: _Entry, call: Callable[[Client], Awaitable[Result]], *, repeat: bool
    ) -> Result:
        """A call, and what it tells of the connection."""
        before, entry.proven, entry.doubtful = entry.proven, False, True
        try:
            try:
                result = await call(entry.client)
            except ConnectionLost as error:
                if not (repeat and before and error.maybe_sent):
                    raise
                result = await call(entry.client)
        except ModbusException:
            entry.proven, entry.doubtful = True, False
            raise
        entry.proven, entry.doubtful = True, False
        return result

    async def _entry(self, key: NetworkTarget, timeout: float) -> _Entry:
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep())
        if key not in self._entries:
            made = await self._client(key, timeout)
        entry = self._entries.get(key)  # Another request may have made it meanwhile.
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
        """A client. What can't be cancelled, which TCP can, has the timeout of the request."""
        timeout = self._longest if key.transport in IN_FLIGHT else timeout
        if key.transport != "tls":
            return self._dial(key, timeout=timeout, in_flight=self._in_flight), timeout
        return await asyncio.to_thread(self._dial_tls, key, timeout), timeout

    def _dial_tls(self, key: NetworkTarget, timeout: float) -> Client:
        """A client with TLS, whose files are read now, which takes its time."""
        try:
            return self._dial(key, timeout=timeout, in_flight=self._in_flight)
        except (OSError, ValueError):
            try:
                check_files(self._tls)
            except (OSError, ValueError) as error:
                raise Unusable(str(error)) from None
            raise

    async def _refresh(self, key: NetworkTarget, entry: _Entry, timeout: float) -> None:
        """Makes a client fit for a request that has its turn; files may have been renewed."""
        other = key.transport not in IN_FLIGHT and timeout != entry.timeout
        if entry.active > 1 or not (entry.doubtful or other):
            return
        made = entry.client, entry.timeout
        if other or key.transport == "tls":
            made = await self._client(key, timeout)
        if entry.active > 1:  # Meanwhile another uses it.
            return
        old = entry.client
        entry.proven = entry.doubtful = False
        entry.client, entry.timeout = made
        await old.close()

    def _pushed_out(self) -> _Entry:
        """Takes out the one that was used longest ago, of those in no use. Raises `Full`."""
        free = [key for key, entry in self._entries.items() if entry.users == 0]
        if not free:
            raise Full
        return self._entries.pop(min(free, key=lambda key: self._entries[key].used))

    async def _keep(self) -> None:
        """Closes what nobody uses, and everything at the end."""
        try:
            while True:
                await asyncio.sleep(CHECK_INTERVAL)
                await self._close_unused()
        finally:
            for entry in self._entries.values():
                with contextlib.suppress(Exception):
                    await entry.client.close()

    async def _close_unused(self) -> None:
        latest = time.monotonic() - self._idle
        for key, entry in list(self._entries.items()):
            if entry.users == 0 and (entry.doubtful or entry.used < latest):
                del self._entries[key]
                await entry.client.close()
