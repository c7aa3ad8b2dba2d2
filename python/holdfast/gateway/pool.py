"""Connections to devices, kept and shared: many requests to one device go down one of them.

A connection is made when it is needed. It is closed when nobody has used it for a while, and when
the last request on it was given up: what state the device is in is not known then.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from holdfast.client import Client
from holdfast.errors import ConnectionLost, ModbusException

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from typing import Protocol

    from holdfast.gateway.egress import Route
    from holdfast.target import Transport

    class Dial(Protocol):
        """Makes clients, which connect when they are first used."""

        def __call__(
            self, transport: Transport, address: str, port: int, *, timeout: float, in_flight: int
        ) -> Client:
            """The client of an address."""
            ...

    Key: TypeAlias = tuple[Transport, str, int]

Result = TypeVar("Result")

LOOK = 0.5
"""Seconds between two looks for connections that nobody uses."""


class Full(Exception):
    """As many devices as there may be are talked to right now."""


def dial(
    transport: Transport, address: str, port: int, *, timeout: float, in_flight: int
) -> Client:
    """A client of an address."""
    host = f"[{address}]" if ":" in address else address
    return Client(f"{transport}://{host}:{port}", timeout=timeout, max_in_flight=in_flight)


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
    """Clients by transport, address and port; `most` of them, each idle for `idle` seconds at most.

    Over TCP, `in_flight` requests are on their way to a device at once, otherwise one; more wait.
    `longest` is the most seconds that a request takes.
    """

    def __init__(
        self, *, most: int, in_flight: int, idle: float, longest: float, dial: Dial = dial
    ) -> None:
        self._most = most
        self._in_flight = in_flight
        self._idle = idle
        self._longest = longest
        self._dial = dial
        self._entries: dict[Key, _Entry] = {}
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
        Raises `Full`, and what the call raises.
        """
        keys: list[Key] = [(route.transport, each, route.port) for each in route.addresses]
        keys.sort(key=lambda key: key not in self._entries)
        for key in keys[:-1]:
            try:
                return await self._run(key, timeout, call, repeat=repeat)
            except ConnectionLost as error:
                if not could_not_connect(error):
                    raise
        return await self._run(keys[-1], timeout, call, repeat=repeat)

    async def _run(
        self,
        key: Key,
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
                if not (repeat and before) or could_not_connect(error):
                    raise
                result = await call(entry.client)
        except ModbusException:
            entry.proven, entry.doubtful = True, False
            raise
        entry.proven, entry.doubtful = True, False
        return result

    async def _entry(self, key: Key, timeout: float) -> _Entry:
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep())
        entry = self._entries.get(key)
        if entry is None:
            gone = self._pushed_out() if len(self._entries) >= self._most else None
            in_flight = self._in_flight if key[0] == "tcp" else 1
            entry = _Entry(*self._client(key, timeout), asyncio.Semaphore(in_flight))
            self._entries[key] = entry
            if gone is not None:
                entry.users += 1
                try:
                    await gone.client.close()
                finally:
                    entry.users -= 1
        return entry

    def _client(self, key: Key, timeout: float) -> tuple[Client, float]:
        """A client. What can't be cancelled, which TCP can, has the timeout of the request."""
        timeout = self._longest if key[0] == "tcp" else timeout
        return self._dial(*key, timeout=timeout, in_flight=self._in_flight), timeout

    async def _refresh(self, key: Key, entry: _Entry, timeout: float) -> None:
        """Makes a client fit for a request that has its turn."""
        other = key[0] != "tcp" and timeout != entry.timeout
        if entry.active == 1 and (entry.doubtful or other):
            entry.proven = entry.doubtful = False
            await entry.client.close()
            if other:
                entry.client, entry.timeout = self._client(key, timeout)

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
                await asyncio.sleep(LOOK)
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


def could_not_connect(error: ConnectionLost) -> bool:
    """Whether nothing was sent, because no connection could be made."""
    return str(error).startswith("can't connect")
