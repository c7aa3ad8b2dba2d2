"""The transports of the client for asyncio.

Over TCP and TLS: many requests in flight on one connection, without threads. The native connection
frames requests, matches replies, tracks deadlines and handles TLS; `AsyncConnection` owns the
socket and one timer. Requests from the same turn of the event loop are sent in one
write, and replies that arrive together are delivered together, so a busy connection causes few
wake-ups. A request runs as little Python as possible: a reply goes from the native connection to
the future of its request. All other transports have one request at a time: `ThreadedConnection`.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import socket
import warnings
from collections import deque
from math import ceil, inf
from threading import Event
from typing import TYPE_CHECKING, Any, Protocol, cast
from weakref import ref

from holdfast._core import Attempt, BlockingClient, Connection
from holdfast.client.endpoint import endpoint
from holdfast.client.fork import renew_in_children
from holdfast.client.program_end import end_at_exit, sleep_at_end
from holdfast.client.tcp_connect import addresses, connected, limit_resends
from holdfast.errors import ConnectFailed, ConnectionLost, ModbusError, RequestTimeout
from holdfast.runtime.own_thread import OwnThread
from holdfast.runtime.text import os_error_text

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from concurrent.futures import Future

    from holdfast._core import Endpoint, Request
    from holdfast.client.base import Trace
    from holdfast.client.url import NetworkTarget, Target

CLOSED = "connection lost: closed by this side"


class AsyncTransport(Protocol):
    """Carries calls to a device, for asyncio. `BlockingClient` of the core is the other one."""

    def call(self, request: Request, unit: int, timeout: float) -> Awaitable[Any]:
        """Sends a request, and waits for the result."""
        ...

    async def close(self) -> None:
        """Closes the connection."""

    @property
    def late(self) -> int:
        """How many replies arrived after their timeout."""

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of them took; 0 if there were none."""


class OwnTransport(AsyncTransport, Protocol):
    """Has a connection of its own."""

    def call(
        self,
        request: Request,
        unit: int,
        timeout: float,
        note_sent: Callable[[], None] | None = None,
    ) -> Awaitable[Any]:
        """Calls `note_sent` when the device may receive the request from now on.

        It may be called again, in any thread, and nothing is sent if it raises.
        """
        ...


class ThreadedConnection:
    """A transport with one request at a time, in a thread of its own, and in one event loop at a
    time."""

    _thread: _CallThread | None = None
    _closing: Future[None] | None = None
    """Done when the thread before has closed the connection."""
    _loop: asyncio.AbstractEventLoop | None = None
    """The event loop that uses the thread."""

    def __init__(self, target: Target, trace: Trace | None = None) -> None:
        self._target = target
        self._endpoint = endpoint(target)
        self._trace = trace
        self._connect_anew()
        renew_in_children(self, ThreadedConnection._connect_anew)

    def _connect_anew(self) -> None:
        self._core = BlockingClient(self._endpoint, self._trace)
        self._thread = self._closing = None

    async def call(
        self,
        request: Request,
        unit: int,
        timeout: float,
        note_sent: Callable[[], None] | None = None,
    ) -> Any:
        """Sends a request after the calls before it, and waits for the result.

        Raises `RuntimeError` while the client is in use in another event loop, and if the program
        ends.
        """
        self._loop = self._here()
        if note_sent is not None:
            note_sent()  # The thread may send it at any time.
        if self._thread is None or self._thread.is_closed:  # The end of the program closes it too.
            self._thread = _CallThread(self._core, self._closing)
            self._closing = None
        return await self._thread.carry(request, unit, timeout, note_sent)

    async def close(self) -> None:
        """Closes the connection; the current call and waiting calls fail."""
        self._here()
        thread, self._thread = self._thread, None
        if thread is not None:
            self._closing = thread.ended
            thread.close()
            await asyncio.wrap_future(thread.ended)

    def _here(self) -> asyncio.AbstractEventLoop:
        """This loop, which may use the connection."""
        loop = asyncio.get_running_loop()
        if self._thread is not None and self._loop is not loop:
            _check_closed(self._loop)
        return loop

    def __del__(self, _warn: Callable[..., None] = warnings.warn) -> None:
        if self._thread is not None:
            _warn(f"unclosed client of {self._target}", ResourceWarning, source=self)
            self._thread.close()

    @property
    def late(self) -> int:
        """How many replies arrived after their timeout."""
        return self._core.late

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of them took; 0 if there were none."""
        return self._core.longest_late


class _CallThread(OwnThread):
    """The thread of a `ThreadedConnection`, until that is closed. Its calls have a reference to
    this, and not to that, which nobody may have any more after a cancellation."""

    def __init__(self, core: BlockingClient, closing: Future[None] | None) -> None:
        """Its calls begin when the thread before is `closing` no more, so none delays that."""
        super().__init__("holdfast-client")
        self._core = core
        self.is_closed = False
        self.start()
        end_at_exit(self)
        if closing is not None:
            self.submit(closing.result)

    async def carry(
        self,
        request: Request,
        unit: int,
        timeout: float,
        note_sent: Callable[[], None] | None = None,
    ) -> Any:
        """Sends a request after the calls before it, and waits for the result."""
        cancelled = Event()

        def is_over() -> bool:
            if note_sent is not None:
                note_sent()  # The core asks until it sends, and sends nothing after an error.
            return cancelled.is_set() or self.is_closed

        def call() -> Any:
            if self.is_closed:  # While this call waited for its turn.
                raise _closed_before_sent()
            return self._core.call(request, unit, timeout, is_over)

        try:
            return await self.call(call)
        except asyncio.CancelledError:
            cancelled.set()
            raise

    def close(self) -> None:
        """Lets the thread end: its calls fail, and it closes the connection."""
        if not self.is_closed:
            # First: `end_call` ends no call that begins only now.
            self.is_closed = True
            self._core.end_call()
            self.submit(self._close)
            self.end()

    def _close(self) -> None:
        self._core.close()

    def __del__(self) -> None:
        # Python may finalize it before the connection, which could then submit nothing any more.
        if self._thread is not None:
            self.close()


class AsyncConnection:
    """The connection of a client over TCP or TLS, in one event loop at a time."""

    _last: _LoopConnection | None = None
    """The connection of the latest loop. A copy that has failed has only this `None` at its end."""

    def __init__(
        self,
        target: NetworkTarget,
        endpoint: Endpoint,
        max_in_flight: int,
        trace: Trace | None = None,
    ) -> None:
        self._target = target
        self._endpoint = endpoint
        self._trace = trace
        self._max_in_flight = 1 if target.tolerance.is_one_at_a_time else max_in_flight
        self._connect_anew()
        renew_in_children(self, AsyncConnection._connect_anew)

    def _connect_anew(self) -> None:
        self._last = None

    async def call(
        self,
        request: Request,
        unit: int,
        timeout: float,
        note_sent: Callable[[], None] | None = None,
    ) -> Any:
        """Sends a request as soon as a place is free, and waits for the result.

        Raises `RuntimeError` while the client is in use in another event loop.
        """
        here = self._last
        if here is None or here.loop is not asyncio.get_running_loop():
            here = self._here()
        closes = here.closes
        if here.free:
            here.free -= 1
        else:
            await here.turn()
        try:
            if here.closes != closes:
                raise _closed_before_sent()
            now, left, attempt = here.time(), timeout, None
            deadline = now + timeout
            while True:
                connection = here.open
                if connection is None:
                    connection = await here.connected(deadline, timeout)
                # Without pauses the core needs no later time than that of the call.
                if here.has_pauses or attempt is not None:
                    now = here.time()
                    left = max(deadline - now, 0.0)
                if timeout > here.resend_limit_s:
                    here.cover(timeout)
                if note_sent is not None:
                    note_sent()
                try:
                    future = connection.send(request, unit, left, now, attempt)
                except ConnectionLost:
                    here.end(connection)
                    raise
                try:
                    result = await future
                except asyncio.CancelledError:
                    connection.cancel(future, here.time())
                    if connection.closed is not None:
                        here.end(connection)
                    raise
                except RequestTimeout:
                    if left == timeout:
                        raise
                    raise RequestTimeout(f"no reply within {timeout:g} s") from None
                if type(result) is not Attempt:
                    return result
                attempt = result
                await asyncio.sleep(attempt.pause)
                if here.closes != closes:
                    raise ConnectionLost(CLOSED)
                if attempt.has_own_timeout:
                    deadline = here.time() + timeout
        finally:
            if here.queue:
                here.next_turn()
            else:
                here.free += 1

    async def close(self) -> None:
        """Closes the connection; pending calls fail."""
        await self._here().close()

    def __del__(self, _warn: Callable[..., None] = warnings.warn) -> None:
        last = self._last
        if last is None or not last.is_connected:
            return
        _warn(f"unclosed client of {self._target}", ResourceWarning, source=self)
        try:
            last.loop.call_soon_threadsafe(last.abandon)
        except RuntimeError:  # The loop is closed.
            last.close_socket()

    @property
    def late(self) -> int:
        """How many replies arrived after their timeout."""
        return 0 if self._last is None else self._last.late

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of them took; 0 if there were none."""
        return 0.0 if self._last is None else self._last.longest_late

    def _here(self) -> _LoopConnection:
        """The connection of this loop. In another loop it starts over."""
        loop, last = asyncio.get_running_loop(), self._last
        if last is not None and last.loop is loop:
            return last
        if last is not None and last.in_use:
            _check_closed(last.loop)
        if last is not None and last.loop.is_closed():
            last.close_socket()
        # An object for each loop: calls that a closed loop has left behind may end at any time,
        # and must not give back places of the new one.
        late = (0, 0.0) if last is None else (last.late, last.longest_late)
        # The trace often belongs to the owner of the client: the loop must not keep that alive.
        myself = ref(self)

        def trace(direction: str, data: bytes) -> None:
            client = myself()
            if client is not None and client._trace is not None:
                client._trace(direction, data)

        here = _LoopConnection(
            self._target,
            self._endpoint,
            self._max_in_flight,
            None if self._trace is None else trace,
            loop,
            *late,
        )
        self._last = here
        sleep_at_end(loop)
        return here


class _LoopConnection:
    """A connection in one event loop. Connects on demand, and reconnects after a loss."""

    def __init__(
        self,
        target: NetworkTarget,
        endpoint: Endpoint,
        max_in_flight: int,
        trace: Trace | None,
        loop: asyncio.AbstractEventLoop,
        late: int,
        longest_late: float,
    ) -> None:
        self.loop = loop
        self.time = loop.time
        self.has_pauses = target.tolerance.has_pauses
        self.free = max_in_flight
        """Requests that may be sent before one ends."""
        self.queue: deque[asyncio.Future[None]] = deque()
        """The calls that wait for one to end."""
        self.open: Connection | None = None
        self.closes = 0
        """How often the client was closed: no call from before is sent after that."""
        self.resend_limit_s = 0
        """How long the system repeats bytes on the open connection; 0: no request was sent yet."""
        self._max_in_flight = max_in_flight
        self._target = target
        self._endpoint = endpoint
        self._trace = trace
        self._kind = _Buffered if isinstance(loop, asyncio.BaseEventLoop) else _Streamed
        self._late_before = late
        self._longest_late_before = longest_late
        """The late replies of connections that have ended."""
        self._protocol: _Protocol | None = None
        """The transport of the open connection."""
        self._socket: socket.socket | None = None
        self._newest: Connection | None = None
        """Open or ended: its late replies may come on the next one."""
        self._connecting: asyncio.Task[_Protocol] | None = None
        self._is_looking_up = False
        """Whether the attempt to connect waits, or has waited, for the addresses of the host."""
        self._connect_at = -inf

    def cover(self, timeout: float) -> None:
        """Called before a request is sent whose timeout is longer than those before it. In whole
        seconds, as in the core: it seldom changes."""
        assert self._socket is not None
        self.resend_limit_s = max(ceil(timeout), 1)
        limit_resends(self._socket, self.resend_limit_s)

    def end(self, connection: Connection) -> None:
        """Ends a connection that can't send any more: it has had its number of requests, or all
        its transaction ids wait for late replies."""
        if self._protocol is not None and self._protocol.core is connection:
            self._protocol.close()

    async def close(self) -> None:
        self.closes += 1
        for turn in self.queue:
            if not turn.done():
                turn.set_exception(_closed_before_sent())
        self.queue.clear()
        if self._connecting is not None:
            self._connecting.cancel()
            await asyncio.wait([self._connecting])
        if self._protocol is not None:
            ended = self._protocol.ended
            self._protocol.close()
            # Not the future itself: whoever cancels this must not cancel what the connection sets.
            await asyncio.wait([ended])

    def abandon(self) -> None:
        """Closes the connection of a client that is no more, which has no pending calls."""
        if self._connecting is not None:
            self._connecting.cancel()
            self._connecting.add_done_callback(lambda _: self.abandon())
        elif self._protocol is not None:
            self._protocol.close()

    def close_socket(self) -> None:
        """Closes the connection of a loop that is closed, and can't do it any more. Otherwise the
        device would have it until Python finds the cycle that the transport is in."""
        if self._socket is not None:
            self._socket.close()

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, or an attempt to make one."""
        return self.open is not None or self._connecting is not None

    @property
    def in_use(self) -> bool:
        """Whether there is a connection, or a pending call."""
        return self.is_connected or self.free < self._max_in_flight

    @property
    def late(self) -> int:
        return self._late_before + (0 if self.open is None else self.open.late)

    @property
    def longest_late(self) -> float:
        here = 0.0 if self.open is None else self.open.longest_late
        return max(self._longest_late_before, here)

    async def turn(self) -> None:
        """Waits for a free place in flight, in the order of the calls."""
        turn = self.loop.create_future()
        self.queue.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled() and turn.exception() is None:
                self.next_turn()
            raise

    def next_turn(self) -> None:
        """Gives a free place to the next waiting call."""
        while self.queue:
            turn = self.queue.popleft()
            if not turn.done():
                turn.set_result(None)
                return
        self.free += 1

    async def connected(self, deadline: float, timeout: float) -> Connection:
        """The connection; connects if necessary. Several calls can wait for the same attempt."""
        is_own, closes = self._connecting is None, self.closes
        if self._connecting is None:
            self._connecting = self.loop.create_task(self._connect(timeout))
            self._connecting.add_done_callback(self._connect_ended)
        connecting = self._connecting
        done, _ = await asyncio.wait([connecting], timeout=deadline - self.loop.time())
        if not done:
            raise self._not_in_time(timeout)
        if connecting.cancelled():
            raise _closed_before_sent()
        failure = connecting.exception()
        if isinstance(failure, RequestTimeout) and not is_own and self.loop.time() < deadline:
            if self.closes != closes:
                raise _closed_before_sent()
            return await self.connected(deadline, timeout)  # The other call had less time.
        if isinstance(failure, ModbusError):
            raise copy.copy(failure) from failure.__cause__
        return connecting.result().core

    async def _connect(self, timeout: float) -> _Protocol:
        target = self._target
        self._is_looking_up = False
        if self._connect_at > self.loop.time():
            await asyncio.sleep(self._connect_at - self.loop.time())
        self._newest = core = Connection(self._endpoint, self.loop, self._newest, self._trace)
        protocol = self._kind(self, core)
        deadline = self.loop.time() + timeout
        try:
            async with asyncio.timeout_at(deadline):
                try:
                    self._is_looking_up = True
                    found = await addresses(target.host, target.port)
                    self._is_looking_up = False
                    self._socket = await connected(found, deadline)
                    self.resend_limit_s = 0
                    await self.loop.create_connection(lambda: protocol, sock=self._socket)
                except OSError as error:
                    if isinstance(error, TimeoutError) and error.errno is None:
                        raise  # Of this side, not of the system.
                    raise connect_failed(target, error) from error
                await protocol.ready
        except BaseException as error:
            # Also if it is ready: nobody will use it.
            protocol.close()
            if isinstance(error, TimeoutError):
                raise self._not_in_time(timeout) from None
            raise
        return protocol

    def _not_in_time(self, timeout: float) -> RequestTimeout:
        why = ": its name was not resolved" if self._is_looking_up else ""
        text = f"no connection to {self._target} within {timeout:g} s{why}"
        return RequestTimeout(text, maybe_sent=False)

    def _connect_ended(self, task: asyncio.Task[_Protocol]) -> None:
        self._connecting = None
        # The connection may already be lost.
        if not task.cancelled() and task.exception() is None and task.result().is_ready:
            self._protocol = task.result()
            self.open = self._protocol.core

    def lost(self, connection: _Protocol) -> None:
        """The connection has ended: the next call makes a new one."""
        self._connect_at = self.loop.time() + self._target.tolerance.reconnect
        core = connection.core
        self._late_before += core.late
        self._longest_late_before = max(self._longest_late_before, core.longest_late)
        if self._protocol is connection:
            self._protocol = self.open = None


class _Protocol(asyncio.BaseProtocol):
    """The socket of one connection, and its timer. Received bytes go to the native connection."""

    def __init__(self, here: _LoopConnection, core: Connection) -> None:
        self.core = core
        self._here = here
        self._loop = here.loop
        self.ready: asyncio.Future[None] = self._loop.create_future()
        """Done when requests can be sent."""
        self.ended: asyncio.Future[None] = self._loop.create_future()
        """Done when the socket is closed."""
        self._alarm: asyncio.TimerHandle | None = None
        self._transport: asyncio.Transport | None = None

    @property
    def is_ready(self) -> bool:
        """Whether requests can be sent."""
        return self._transport is not None and self.core.is_ready

    def close(self) -> None:
        """Closes the connection; pending requests raise `ConnectionLost`."""
        self.core.close()
        self._changed()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # Those of uvloop have no such base.
        self.core.opened(self._transport.write, self._flush_soon, self._wake_at, self._changed)
        self._changed()

    def connection_lost(self, exc: Exception | None) -> None:
        self.core.lost(None if exc is None else explained(exc))
        self._changed()
        self.ended.set_result(None)

    def _changed(self) -> None:
        """Continues the handshake, and handles the end of the connection."""
        if not self.ready.done() and self.core.closed is None:
            self._greet()
        closed = self.core.closed
        if closed is not None:
            self._end(closed)

    def _greet(self) -> None:
        """Continues the handshake before the first request."""
        self._flush()
        if self.core.is_ready:
            self.ready.set_result(None)

    def _end(self, why: ModbusError) -> None:
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None
        if not self.ready.done():
            self.ready.set_exception(why)
            self.ready.exception()  # Marks it retrieved: the waiting call may be cancelled.
        transport, self._transport = self._transport, None
        if transport is not None:
            self._here.lost(self)
            if not transport.is_closing():
                # One of uvloop does not say so if it was closed before `create_connection` ended.
                with contextlib.suppress(RuntimeError):
                    self.core.flush()
            self.core.detach()
            transport.abort()

    def _flush_soon(self) -> None:
        """Sends what waits at the end of this turn of the loop."""
        self._loop.call_soon(self._flush)

    def _flush(self) -> None:
        if self._transport is not None:
            self.core.flush()

    def _wake_at(self, at: float) -> None:
        if self._alarm is not None:
            self._alarm.cancel()
        self._alarm = self._loop.call_at(at, self._look_at_deadlines)

    def _look_at_deadlines(self) -> None:
        """Ends calls after their deadline, and sets the timer for the next deadline."""
        self._alarm = None
        deadline = self.core.advance()
        self._changed()
        if self._here.has_pauses:
            self._flush()
        if deadline is not None and self._transport is not None:
            self._wake_at(deadline)


class _Buffered(_Protocol, asyncio.BufferedProtocol):
    """For loops of asyncio, which would allocate 256 KB for each reply."""

    def __init__(self, here: _LoopConnection, core: Connection) -> None:
        super().__init__(here, core)
        self.get_buffer = core.get_buffer  # type: ignore[assignment, method-assign]
        self.buffer_updated = core.buffer_updated  # type: ignore[assignment, method-assign]


class _Streamed(_Protocol, asyncio.Protocol):
    """For loops that allocate what they have received, such as uvloop."""

    def __init__(self, here: _LoopConnection, core: Connection) -> None:
        super().__init__(here, core)
        self.data_received = core.data_received  # type: ignore[assignment, method-assign]


def _check_closed(loop: asyncio.AbstractEventLoop | None) -> None:
    """Raises `RuntimeError` unless the loop that has used a client is closed."""
    if loop is not None and not loop.is_closed():
        raise RuntimeError("the client is in use in another event loop: close it there")


def _closed_before_sent() -> ConnectionLost:
    """The error of a call that `close` has ended before its request was sent."""
    error = ConnectionLost(CLOSED)
    error.maybe_sent = False
    return error


def connect_failed(target: NetworkTarget, error: OSError) -> ConnectFailed:
    """The error of a client for that of the system."""
    # The numbers of lookups are not those of the system.
    number = None if isinstance(error, socket.gaierror) else error.errno
    return ConnectFailed(str(target), explained(error), number)


def explained(error: Exception) -> str:
    """The system's text for an error, without the address that asyncio adds."""
    return os_error_text(error) if isinstance(error, OSError) else str(error)
