"""A pool of connections to devices. All requests to one device share one connection, in turns.

In an appliance, devices that it uses itself are asked over its own connections (`shared_devices`).

A connection is opened when it is needed. It is closed when it is idle for some time, and when the
last request on it had no response, because the state of the connection is then unknown. Where
replies have no transaction ids, its client stays: it knows which ones may come on the next
connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from holdfast._core import MAX_LATENESS_S
from holdfast.client.client import connection
from holdfast.client.endpoint import check_files
from holdfast.client.url import IN_FLIGHT, NetworkTarget
from holdfast.errors import ConnectionLost, ModbusException, RequestTimeout
from holdfast.gateway import broadcast
from holdfast.gateway.shared_devices import Elsewhere, Turns
from holdfast.gateway.shared_reads import WaitingRequests
from holdfast.net.http.requests import BadRequest
from holdfast.net.tls import NO_FILES

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast._core import Request
    from holdfast.client.async_transports import OwnTransport
    from holdfast.gateway.device_routes import Route
    from holdfast.gateway.shared_devices import ApplianceLinks
    from holdfast.net.tls import Tls

Result = TypeVar("Result")

Dial: TypeAlias = "Callable[[NetworkTarget, int], OwnTransport]"
"""Creates the connection to an address, for a number of requests in flight. It connects when it is
first used. Raises `OSError` and `ValueError` for TLS files that can't be used."""

CHECK_INTERVAL_S = 0.5
"""Between checks for idle connections."""


class Unusable(Exception):
    """The TLS files, which were valid at the start, can't be used any more."""


@dataclass(eq=False)
class _Device:
    """A connection, its users, and the requests that wait for it."""

    key: NetworkTarget
    transport: OwnTransport
    most: int
    """The most requests in flight."""
    in_flight: int = 0
    waiting: WaitingRequests = field(default_factory=WaitingRequests)
    workers: set[asyncio.Task[None]] = field(default_factory=set)
    users: int = 0
    """The number of calls that use the connection or wait for it."""
    used: float = field(default_factory=time.monotonic)
    is_state_unknown: bool = False
    """Whether the last request had no response."""
    late_replies_until: float = -inf
    """Until then, late replies may come that only this client knows."""


def _expects_late_replies(device: _Device) -> bool:
    """Returns whether late replies may come that only this client knows."""
    return device.key.transport not in IN_FLIGHT and time.monotonic() < device.late_replies_until


class _PoolTurns(Turns):
    """Turns on a connection of the pool."""

    def __init__(self, pool: Pool, device: _Device) -> None:
        super().__init__(device.key)
        self._pool = pool
        self._device = device

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        """Sends a request when its turn comes. Raises the errors of a client, and `Unusable`."""
        earlier = self.is_sent
        try:
            return await self._call(self._device, request, unit, timeout)
        except (ConnectionLost, RequestTimeout) as error:
            self.is_sent = error.maybe_sent = earlier or error.maybe_sent
            raise

    async def _call(self, device: _Device, request: Request, unit: int, timeout: float) -> Any:
        if device.in_flight < device.most:
            device.in_flight += 1
            try:
                note_sent = partial(self._note_sent, request)
                return await self._pool.send(device, request, unit, timeout, note_sent)
            finally:
                self._pool.pass_on(device)
        waiting = device.waiting.join(request, unit, timeout, self.check)
        caller = asyncio.get_running_loop().create_future()
        waiting.callers.append(caller)
        try:
            return await caller
        finally:
            self.is_sent |= waiting.is_sent
            waiting.callers.remove(caller)
            if not waiting.callers:
                if waiting.worker is not None:
                    waiting.worker.cancel()
                elif waiting.is_queued:
                    device.waiting.leave(waiting)

    def _note_sent(self, request: Request) -> None:
        self.check(request)
        self.is_sent = True


class Pool:
    """At most `most` clients, by target. A client is closed after `idle` seconds without use.

    Over TCP and TLS, at most `in_flight` requests to a device are pending at once; over other
    transports one. Further requests wait.
    """

    def __init__(
        self,
        *,
        most: int,
        in_flight: int,
        idle: float,
        tls: Tls = NO_FILES,
        dial: Dial = connection,
        shared: ApplianceLinks | None = None,
    ) -> None:
        self._most = most
        self._in_flight = in_flight
        self._idle = idle
        self._tls = tls
        self._dial = dial
        self._shared = shared
        self._entries: dict[NetworkTarget, _Device] = {}
        self._keeper: asyncio.Task[None] | None = None

    def __len__(self) -> int:
        return len(self._entries)

    async def run(
        self,
        route: Route,
        timeout: float,
        call: Callable[[Turns], Awaitable[Result]],
    ) -> Result:
        """Runs a call on the connection to a device, trying its addresses in turn.

        The connection is that of the appliance, if it uses the host or one of the addresses, and
        the connection leads to one of them.

        `timeout` is in seconds; the caller must cancel the call when it expires. Raises
        `BadRequest` if all connections are in use, `Unusable`, `ValueError` for an invalid
        certificate name, and the exceptions of the call.
        """
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep())
        if self._shared is not None:
            for target in dict.fromkeys((route.named, *route.allowed)):
                # A connection by the name may have been made to any address of the name.
                peers = None if target in route.allowed else route.addresses
                turns = await self._shared.turns(target, timeout, peers)
                if turns is not None:
                    with contextlib.suppress(Elsewhere):
                        return await call(turns)
        # Addresses with a connection first.
        *earlier, last = sorted(route.allowed, key=lambda each: each not in self._entries)
        for target in earlier:
            try:
                return await self._run(target, call)
            except ConnectionLost as error:
                if error.maybe_sent:
                    raise
        return await self._run(last, call)

    async def _run(self, key: NetworkTarget, call: Callable[[Turns], Awaitable[Result]]) -> Result:
        device = self._entries.get(key) or await self._new_entry(key)
        device.users += 1
        try:
            return await call(_PoolTurns(self, device))
        finally:
            device.users -= 1

    async def send(
        self,
        device: _Device,
        request: Request,
        unit: int,
        timeout: float,
        note_sent: Callable[[], None],
    ) -> Any:
        """Sends a request whose turn has come, and returns the result."""
        key = device.key
        try:
            if device.is_state_unknown and device.in_flight == 1:
                await self._refresh(device)
            device.is_state_unknown = True
            result = None
            if broadcast.is_broadcast(key.transport, unit):
                await device.transport.close()  # The peer may accept only one connection.
                note_sent()
                await broadcast.send(self._dial(key, 1), request, timeout)
            else:
                result = await device.transport.call(request, unit, timeout, note_sent)
            device.is_state_unknown = False
            return result
        except ModbusException:
            device.is_state_unknown = False
            raise
        finally:
            device.used = time.monotonic()
            if device.is_state_unknown:
                device.late_replies_until = device.used + timeout + MAX_LATENESS_S

    def pass_on(self, device: _Device) -> None:
        """Gives the place of a request that has ended to those that wait."""
        if device.waiting:
            self._start(device)
        else:
            device.in_flight -= 1

    def _start(self, device: _Device, *, close: bool = False) -> None:
        worker = asyncio.create_task(self._work(device, close=close))
        device.workers.add(worker)  # The event loop has only weak references.

    async def _work(self, device: _Device, *, close: bool) -> None:
        """Sends the requests that wait, each as soon as the one before it has ended.

        The callers would send theirs later, after the work with the reply before it.
        """
        worker = asyncio.current_task()
        assert worker is not None
        try:
            if close:
                device.is_state_unknown = False
                try:
                    await device.transport.close()
                except Exception:
                    device.is_state_unknown = True  # The next request closes it, or gets the error.
            while device.waiting:
                now = device.waiting.first
                if all(caller.done() for caller in now.callers):
                    await asyncio.sleep(0)  # They have given up, and leave the queue next.
                    continue
                device.waiting.leave(now)
                now.worker = worker
                outcome: Any
                try:
                    outcome = await self.send(
                        device, now.request, now.unit, now.timeout, now.note_sent
                    )
                except asyncio.CancelledError:
                    if now.callers:  # The pool ends.
                        raise
                    worker.uncancel()
                    continue
                except Exception as error:
                    outcome = error
                now.end(outcome)
        finally:
            device.in_flight -= 1
            device.workers.discard(worker)

    async def _new_entry(self, key: NetworkTarget) -> _Device:
        transport = await self._dialed(key)
        device = self._entries.get(key)  # Another request may have created it meanwhile.
        if device is None:
            gone = self._pushed_out() if len(self._entries) >= self._most else None
            most = self._in_flight if key.transport in IN_FLIGHT else 1
            device = self._entries[key] = _Device(key, transport, most)
            if gone is not None:
                device.users += 1  # So that it is not pushed out in turn.
                try:
                    await gone.transport.close()
                finally:
                    device.users -= 1
        return device

    async def _dialed(self, key: NetworkTarget) -> OwnTransport:
        if key.transport != "tls":
            return self._dial(key, self._in_flight)
        return await asyncio.to_thread(self._dial_tls, key)

    def _dial_tls(self, key: NetworkTarget) -> OwnTransport:
        """Returns a connection with TLS. Blocks, because it reads the TLS files."""
        try:
            return self._dial(key, self._in_flight)
        except (OSError, ValueError):
            try:
                check_files(self._tls)
            except (OSError, ValueError) as error:
                raise Unusable(str(error)) from None
            raise

    async def _refresh(self, device: _Device) -> None:
        """Closes a connection that is in doubt; reads TLS files again."""
        made = device.transport
        if device.key.transport == "tls":
            made = await self._dialed(device.key)
        if device.in_flight > 1:  # Another request uses it meanwhile.
            return
        old, device.transport = device.transport, made
        device.is_state_unknown = False
        await old.close()

    def _pushed_out(self) -> _Device:
        """Removes the least recently used idle entry. Raises `BadRequest` if all are in use."""
        free = [
            each
            for each in self._entries.values()
            if not (each.users or each.in_flight or _expects_late_replies(each))
        ]
        if not free:
            raise BadRequest("busy", "too many devices are in use, try again later")
        return self._entries.pop(min(free, key=lambda each: each.used).key)

    async def _keep(self) -> None:
        """Closes idle connections, and all connections at the end."""
        try:
            while True:
                await asyncio.sleep(CHECK_INTERVAL_S)
                await self._close_unused()
        finally:
            for entry in self._entries.values():
                with contextlib.suppress(Exception):
                    await entry.transport.close()
            if self._shared is not None:
                self._shared.close()

    async def _close_unused(self) -> None:
        latest = time.monotonic() - self._idle
        if self._shared is not None:
            self._shared.forget_unused(latest)
        for key, entry in list(self._entries.items()):
            # While the one before was closed, a request may have pushed this one out.
            if self._entries.get(key) is not entry or entry.users or entry.in_flight:
                continue
            if _expects_late_replies(entry) and not self._is_shared(key):
                if entry.is_state_unknown:
                    entry.in_flight += 1
                    self._start(entry, close=True)
            elif entry.is_state_unknown or entry.used < latest or self._is_shared(key):
                del self._entries[key]
                with contextlib.suppress(Exception):
                    await entry.transport.close()

    def _is_shared(self, key: NetworkTarget) -> bool:
        """Returns whether the appliance has begun to use the device, which may accept no more."""
        return self._shared is not None and self._shared.knows(key)
