"""Modbus TCP in asyncio, with TLS or not: many requests in flight on one connection, in no thread.

The native session frames requests and matches replies; here are the socket, the deadlines and the
futures. Requests that are made in one turn of the event loop leave with one write, replies that
arrive together are handed out together: a busy connection costs few wake-ups.
"""

from __future__ import annotations

import asyncio
from bisect import insort
from collections import deque
from math import inf
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from holdfast._core import Session
from holdfast.client import tls
from holdfast.errors import ConnectionLost, InvalidResponse, ModbusError, RequestTimeout

if TYPE_CHECKING:
    from collections.abc import Awaitable
    from ssl import SSLContext

    from holdfast._core import Request
    from holdfast.client.target import NetworkTarget

CLOSED = "connection lost: closed by this side"

MAX_CONSECUTIVE_TIMEOUTS = 3
"""Timeouts one after the other, without a byte between them, after which a connection is given up:
the other side may have gone without a word."""


class Link:
    """The connection of a client, in one event loop at a time."""

    def __init__(
        self, target: NetworkTarget, max_in_flight: int, context: SSLContext | None = None
    ) -> None:
        self._target = target
        self._max_in_flight = max_in_flight
        self._context = context
        self._late = 0
        self._here: _LoopLink | None = None

    def call(self, request: Request, unit: int, timeout: float) -> Awaitable[Any]:
        """Sends a request when there is room for it, and waits for the result.

        Raises `RuntimeError` while the client is in use in another event loop.
        """
        loop = asyncio.get_running_loop()
        here = self._here
        if here is None or here.loop is not loop:
            here = self._move(loop)
        return here.call(request, unit, timeout)

    async def close(self) -> None:
        """Ends the connection; calls that wait for anything fail."""
        loop = asyncio.get_running_loop()
        here = self._here
        if here is None or here.loop is not loop:
            here = self._move(loop)
        await here.close()

    @property
    def late(self) -> int:
        """Replies that came after their requests had been given up."""
        return self._late + (0 if self._here is None else self._here.late)

    def _move(self, loop: asyncio.AbstractEventLoop) -> _LoopLink:
        """Begins anew in another loop: what was left behind in one that is closed is gone."""
        old = self._here
        if old is not None:
            if old.in_use and not old.loop.is_closed():
                raise RuntimeError("the client is in use in another event loop: close it there")
            self._late += old.late
        self._here = here = _LoopLink(self._target, self._max_in_flight, self._context, loop)
        return here


class _LoopLink:
    """A connection in its loop, made when it is needed, and again after it was lost."""

    def __init__(
        self,
        target: NetworkTarget,
        max_in_flight: int,
        context: SSLContext | None,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        self.loop = loop
        self._target = target
        self._context = context
        self._max_in_flight = self._free = max_in_flight
        self._queue: deque[asyncio.Future[None]] = deque()
        self._connection: _Connection | None = None
        self._connecting: asyncio.Task[_Connection] | None = None
        self._late = 0

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        if self._free:
            self._free -= 1
        else:
            await self._turn()
        try:
            deadline = self.loop.time() + timeout
            connection = self._connection
            if connection is None:
                connection = await self._connected(deadline, timeout)
            number, future = connection.send(request, unit, deadline, timeout)
            try:
                return await future
            except asyncio.CancelledError:
                connection.give_up(number)
                raise
        finally:
            if self._queue:
                self._next_turn()
            else:
                self._free += 1

    async def close(self) -> None:
        for turn in self._queue:
            if not turn.done():
                turn.set_exception(ConnectionLost(CLOSED))
        self._queue.clear()
        if self._connecting is not None:
            self._connecting.cancel()
            await asyncio.wait([self._connecting])
        if self._connection is not None:
            closed = self._connection.closed
            self._connection.end(ConnectionLost(CLOSED))
            await closed

    @property
    def in_use(self) -> bool:
        """Whether there is a connection, or a call that wants one."""
        connected = self._connection is not None or self._connecting is not None
        return connected or self._free < self._max_in_flight

    @property
    def late(self) -> int:
        return self._late + (0 if self._connection is None else self._connection.session.late)

    async def _turn(self) -> None:
        """Waits for one of the places in flight, first come first served."""
        turn = self.loop.create_future()
        self._queue.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled() and turn.exception() is None:
                self._next_turn()
            raise

    def _next_turn(self) -> None:
        """Gives a place that became free to the next who waits."""
        while self._queue:
            turn = self._queue.popleft()
            if not turn.done():
                turn.set_result(None)
                return
        self._free += 1

    async def _connected(self, deadline: float, timeout: float) -> _Connection:
        """The connection, made if need be; several calls may wait for the same one."""
        if self._connecting is None:
            self._connecting = self.loop.create_task(self._connect(timeout))
            self._connecting.add_done_callback(self._connect_ended)
        connecting = self._connecting
        done, _ = await asyncio.wait([connecting], timeout=deadline - self.loop.time())
        if not done:
            raise self._not_in_time(timeout)
        if connecting.cancelled():
            raise ConnectionLost(CLOSED)
        failure = connecting.exception()
        if isinstance(failure, ModbusError):
            raise _again(failure) from failure.__cause__
        return connecting.result()

    async def _connect(self, timeout: float) -> _Connection:
        target, context = self._target, self._context
        try:
            async with asyncio.timeout(timeout):
                _, connection = await self.loop.create_connection(
                    lambda: _Connection(self),
                    target.host,
                    target.port,
                    ssl=context,
                    server_hostname=self._name if context is not None else None,
                )
        except TimeoutError:
            raise self._not_in_time(timeout) from None
        except (OSError, UnicodeError) as error:
            told = str(error) if context is None else tls.not_agreed(error, self._name)
            raise ConnectionLost(f"can't connect to {target}: {told}") from error
        return connection

    @property
    def secure(self) -> bool:
        """Whether it is by TLS."""
        return self._context is not None

    @property
    def _name(self) -> str:
        """What the certificate of the device is for."""
        return self._target.tls.name or self._target.host

    def _not_in_time(self, timeout: float) -> RequestTimeout:
        return RequestTimeout(f"no connection to {self._target} within {timeout:g} s")

    def _connect_ended(self, task: asyncio.Task[_Connection]) -> None:
        self._connecting = None
        # It may be lost already.
        if not task.cancelled() and task.exception() is None and task.result().ended is None:
            self._connection = task.result()

    def lost(self, connection: _Connection) -> None:
        """The connection has ended: the next call makes a new one."""
        self._late += connection.session.late
        if self._connection is connection:
            self._connection = None


class _Connection(asyncio.Protocol):
    """One connection: requests out, replies in."""

    def __init__(self, here: _LoopLink) -> None:
        self.session = Session()
        self.ended: ModbusError | None = None
        """Why it is over."""
        self._here = here
        self._loop = here.loop
        self.closed: asyncio.Future[None] = self._loop.create_future()
        self._heard = not here.secure
        self._futures: dict[int, asyncio.Future[Any]] = {}
        self._by_deadline: deque[tuple[float, int, asyncio.Future[Any], float]] = deque()
        """The earliest first: deadline, transaction id, future, and the timeout that it had."""
        self._alarm: asyncio.TimerHandle | None = None
        self._alarm_at = inf
        self._flushing = False
        self._timeouts = 0
        self._timed_out = -inf
        """Timeouts since something came, and when the last of them was."""
        self._transport: asyncio.Transport

    def send(
        self, request: Request, unit: int, deadline: float, timeout: float
    ) -> tuple[int, asyncio.Future[Any]]:
        """Sends a request: alone at once, beside others with those of this turn of the loop.

        Returns its transaction id, and what will have the result.
        """
        if self.ended is not None:
            raise _again(self.ended)
        number = self.session.send(request, unit)
        if number is None:
            self.end(ConnectionLost("connection lost: no transaction id is free"))
            raise ConnectionLost("connection lost: no transaction id is free")
        if not self._futures:
            self._transport.write(self.session.outgoing())
        elif not self._flushing:
            self._flushing = True
            self._loop.call_soon(self._flush)
        future = self._futures[number] = self._loop.create_future()
        queue = self._by_deadline
        if queue and deadline < queue[-1][0]:
            insort(queue, (deadline, number, future, timeout), key=itemgetter(0))
        else:
            queue.append((deadline, number, future, timeout))
        if deadline < self._alarm_at:
            self._set_alarm(deadline)
        return number, future

    def give_up(self, number: int) -> None:
        """Nobody waits for the reply any more."""
        if self._futures.pop(number, None) is not None:
            self.session.give_up(number)

    def end(self, error: ModbusError) -> None:
        """Closes the connection; whoever waits for a reply gets the error."""
        if self.ended is not None:
            return
        self.ended = error
        if self._alarm is not None:
            self._alarm.cancel()
        self._here.lost(self)
        self._transport.abort()
        for future in self._futures.values():
            if not future.done():
                future.set_exception(_again(error))
        self._futures.clear()
        self._by_deadline.clear()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._heard = True
        self._timeouts = 0
        completed, broken = self.session.receive(data)
        for number, result in completed:
            future = self._futures.pop(number)
            if future.done():
                continue
            if isinstance(result, ModbusError):
                future.set_exception(result)
            else:
                future.set_result(result)
        while self._by_deadline and self._by_deadline[0][2].done():
            self._by_deadline.popleft()
        if broken is not None:
            self.end(InvalidResponse(f"invalid response: {broken}"))

    def connection_lost(self, exc: Exception | None) -> None:
        why = "closed by the peer" if exc is None else tls.told(exc, heard=self._heard)
        self.end(ConnectionLost(f"connection lost: {why}"))
        self.closed.set_result(None)

    def _flush(self) -> None:
        self._flushing = False
        if self.ended is None:
            self._transport.write(self.session.outgoing())

    def _set_alarm(self, at: float) -> None:
        if self._alarm is not None:
            self._alarm.cancel()
        self._alarm_at = at
        self._alarm = self._loop.call_at(at, self._look_at_deadlines)

    def _look_at_deadlines(self) -> None:
        """Ends the calls whose time is over, and sets the alarm for the next."""
        self._alarm, self._alarm_at = None, inf
        now = self._loop.time()
        timed_out = False
        while self._by_deadline:
            deadline, number, future, timeout = self._by_deadline[0]
            if not future.done():
                if deadline > now:
                    self._set_alarm(deadline)
                    break
                self.give_up(number)
                future.set_exception(RequestTimeout(f"no reply within {timeout:g} s"))
                timed_out = True
                # Requests that were under way together count as one.
                if deadline - timeout >= self._timed_out:
                    self._timeouts += 1
                    self._timed_out = now
            self._by_deadline.popleft()
        if timed_out and self.session.is_amid_reply:
            self.end(ConnectionLost("connection lost: a reply broke off"))
        elif self._timeouts >= MAX_CONSECUTIVE_TIMEOUTS and not self._futures:
            self.end(ConnectionLost("connection lost: nothing came any more"))


def _again(error: ModbusError) -> ModbusError:
    """The same error for another caller: a traceback belongs to one."""
    return type(error)(*error.args)
