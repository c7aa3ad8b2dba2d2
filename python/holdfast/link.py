"""A Modbus TCP connection of asyncio: many requests in flight, none of them in a thread.

The native session frames requests and matches replies; here are the socket, the deadlines and the
futures. The first request of a turn of the event loop leaves at once, those behind it with one
write; replies that arrive together are handed out together. A busy connection costs few wake-ups.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any

from holdfast._core import Session
from holdfast.errors import ConnectionLost, InvalidResponse, ModbusError, RequestTimeout

if TYPE_CHECKING:
    from holdfast._core import Request
    from holdfast.target import NetworkTarget


class Link:
    """A connection that is made when it is needed, and again after it was lost."""

    def __init__(self, target: NetworkTarget, timeout: float, max_in_flight: int) -> None:
        self._target = target
        self.timeout = timeout
        self._free = max_in_flight
        self._queue: deque[asyncio.Future[None]] = deque()
        self._connection: _Connection | None = None
        self._connecting: asyncio.Task[_Connection] | None = None
        self._late = 0

    async def call(self, request: Request, unit: int) -> Any:
        """Sends a request when there is room for it, and waits for the result."""
        if self._free == 0 or self._queue:
            await self._turn()
        else:
            self._free -= 1
        try:
            loop = asyncio.get_running_loop()
            deadline = loop.time() + self.timeout
            connection = self._connection
            if connection is None:
                connection = await self._connected(deadline)
            return await connection.call(request, unit, deadline)
        finally:
            self._next_turn()

    async def close(self) -> None:
        """Ends the connection; calls that wait for a reply fail."""
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.cancel()
            await asyncio.wait([connecting])
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.end(ConnectionLost("connection lost: closed by this side"))
            await connection.closed

    @property
    def late(self) -> int:
        """Replies that came after their requests had been given up."""
        return self._late + (0 if self._connection is None else self._connection.session.late)

    async def _turn(self) -> None:
        """Waits for one of the places in flight, first come first served."""
        turn = asyncio.get_running_loop().create_future()
        self._queue.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
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

    async def _connected(self, deadline: float) -> _Connection:
        """The connection, made if need be; several calls may wait for the same one."""
        if self._connecting is None:
            self._connecting = asyncio.create_task(self._connect())
            self._connecting.add_done_callback(self._connect_ended)
        connecting = self._connecting
        try:
            async with asyncio.timeout_at(deadline):
                await asyncio.wait([connecting])
        except TimeoutError:
            raise RequestTimeout(
                f"no connection to {self._target} within {self.timeout} s"
            ) from None
        if connecting.cancelled():
            raise ConnectionLost("connection lost: closed by this side")
        return connecting.result()

    async def _connect(self) -> _Connection:
        target = self._target
        try:
            async with asyncio.timeout(self.timeout):
                loop = asyncio.get_running_loop()
                _, connection = await loop.create_connection(
                    lambda: _Connection(self), target.host, target.port
                )
        except TimeoutError:
            raise self._not_in_time() from None
        except OSError as error:
            raise ConnectionLost(f"can't connect to {target}: {error}") from error
        return connection

    def _not_in_time(self) -> RequestTimeout:
        return RequestTimeout(f"no connection to {self._target} within {self.timeout} s")

    def _connect_ended(self, task: asyncio.Task[_Connection]) -> None:
        if self._connecting is task:
            self._connecting = None
        if not task.cancelled() and task.exception() is None:
            self._connection = task.result()

    def lost(self, connection: _Connection) -> None:
        """The connection has ended: the next call makes a new one."""
        if self._connection is connection:
            self._connection = None
            self._late += connection.session.late


class _Connection(asyncio.Protocol):
    """One connection: requests out, replies in."""

    def __init__(self, link: Link) -> None:
        self.session = Session()
        self._link = link
        self._loop = asyncio.get_running_loop()
        self.closed: asyncio.Future[None] = self._loop.create_future()
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._deadlines: deque[tuple[float, int, asyncio.Future[Any]]] = deque()
        self._alarm: asyncio.TimerHandle | None = None
        self._flushing = False
        self._transport: asyncio.Transport
        self._ended: ModbusError | None = None

    async def call(self, request: Request, unit: int, deadline: float) -> Any:
        if self._ended is not None:
            raise self._ended
        number = self.session.send(request, unit)
        if number is None:
            self.end(ConnectionLost("connection lost: no transaction id is free"))
            raise ConnectionLost("connection lost: no transaction id is free")
        future: asyncio.Future[Any] = self._loop.create_future()
        self._waiting[number] = future
        self._deadlines.append((deadline, number, future))
        if self._alarm is None:
            self._alarm = self._loop.call_at(deadline, self._look_at_deadlines)
        if not self._flushing:
            self._transport.write(self.session.outgoing())
            self._flushing = True
            self._loop.call_soon(self._flush)
        try:
            return await future
        except asyncio.CancelledError:
            if self._waiting.pop(number, None) is not None:
                self.session.give_up(number)
            raise

    def end(self, error: ModbusError) -> None:
        """Closes the connection; whoever waits for a reply gets the error."""
        if self._ended is not None:
            return
        self._ended = error
        if self._alarm is not None:
            self._alarm.cancel()
        self._link.lost(self)
        self._transport.abort()
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(type(error)(*error.args))
        self._waiting.clear()
        self._deadlines.clear()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        completed, broken = self.session.receive(data)
        for number, result in completed:
            future = self._waiting.pop(number)
            if future.done():
                continue
            if isinstance(result, ModbusError):
                future.set_exception(result)
            else:
                future.set_result(result)
        while self._deadlines and self._deadlines[0][2].done():
            self._deadlines.popleft()
        if broken is not None:
            self.end(InvalidResponse(f"invalid response: {broken}"))

    def connection_lost(self, exc: Exception | None) -> None:
        why = "closed by the peer" if exc is None else str(exc)
        self.end(ConnectionLost(f"connection lost: {why}"))
        self.closed.set_result(None)

    def _flush(self) -> None:
        """Sends what was queued behind the first request of this turn, with one write."""
        self._flushing = False
        if self._ended is None:
            self._transport.write(self.session.outgoing())

    def _look_at_deadlines(self) -> None:
        """Ends the calls whose time is over, and sets the alarm for the next."""
        self._alarm = None
        now = self._loop.time()
        while self._deadlines:
            deadline, number, future = self._deadlines[0]
            if not future.done():
                if deadline > now:
                    self._alarm = self._loop.call_at(deadline, self._look_at_deadlines)
                    return
                self.session.give_up(number)
                self._waiting.pop(number, None)
                future.set_exception(RequestTimeout(f"no reply within {self._link.timeout} s"))
            self._deadlines.popleft()
