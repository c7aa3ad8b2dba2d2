"""The HTTP/1.1 server of all services: calls a handler for each request that the core hands over.

The core admits peers, limits and times connections, decrypts and parses, in a thread of its own. It
hands requests over in batches: each batch wakes the event loop once.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import unquote

from holdfast._core import HttpServer, ParsedWrites
from holdfast.events import log_lines
from holdfast.net import event_loop
from holdfast.net.addresses import joined, parse_address
from holdfast.net.http.requests import (
    BadRequest,
    BrokenBody,
    ClientDisconnected,
    Identity,
    Request,
    Response,
    rejection,
)
from holdfast.runtime import tasks
from holdfast.runtime.heartbeat import PERIOD_S, Heartbeat

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping

    from holdfast._core import HttpExchange, ListeningSocket
    from holdfast.net.addresses import Network
    from holdfast.net.http.https import Https
    from holdfast.net.http.requests import Handler, Headers, SecondStep
    from holdfast.runtime.stop import Stop
    from holdfast.types import WhenFull

    Rejection: TypeAlias = Callable[[int, str, str], Response]

KEEP_ALIVE_S = 60.0
"""Seconds after which an idle connection is closed."""

REQUESTS_PER_BATCH = 16
"""Requests that are answered together. Waking the core for each costs more than the response."""

LARGE_BODY_BYTES = 65_536
"""Larger bodies take turns: handling one can take a second."""

EVICTION_GRACE_S = 1.0
"""Seconds that a peer has to send a request, or to take a response, before it can be evicted."""

STOP_TIMEOUT_S = 3.0
"""Seconds for pending requests to finish when the server stops, by default. Longer than
applications need to end them, so that a loaded machine can still send the answers."""

NOT_HTTP = "not an HTTP request"
UNPARSED = {
    "not_http": (400, NOT_HTTP),
    "header_too_large": (431, "the header has more than 65536 bytes or 100 fields"),
    "not_tls": (400, "this port takes HTTPS: use a URL that begins with https://"),
}
"""What the core refuses without a handler: status and text."""


def address_of(host: str, port: int) -> str:
    """Formats `10.0.0.9:51200` or `[fd00::9]:51200`. An IPv4-mapped address is shown as IPv4."""
    return joined(str(parse_address(host)), port)


@dataclass(frozen=True)
class ConnectionLimits:
    """The limits on open connections, as in the configuration."""

    max_connections: int
    max_connections_per_source: int | None = None
    when_full: WhenFull = "refuse"


@dataclass(eq=False)
class WebServer:
    """Serves the requests on a listening socket: calls a handler for each, one at a time.

    A handler that waits for a body that does not arrive in time gets `BadRequest`. It then has a
    second to answer before the connection is dropped.

    `rejection` creates the response to requests that never reach the handler, or whose handler
    fails, from the status, the reason and a sentence.

    With `https`, connections use TLS. `request_timeout` includes the handshake; connections in it
    have as many places of their own as `limits` gives to all.

    A peer that half-closes the connection still gets its responses. With
    `half_close_is_disconnect`, it means that the client is gone, because a full close looks the
    same to the server.
    """

    name: str
    handler: Handler
    listener: ListeningSocket
    _: KW_ONLY
    sources: Collection[Network]
    limits: ConnectionLimits
    request_timeout: float
    stop_timeout: float = STOP_TIMEOUT_S
    half_close_is_disconnect: bool = False
    rejection: Rejection = rejection
    https: Https | None = None

    def __post_init__(self) -> None:
        self.address = address_of(*self.listener.getsockname())
        self.heartbeat = Heartbeat()
        """The heartbeat of the event loop of `run`."""
        self._last_review = time.monotonic()
        self._server: HttpServer | None = None
        self._counts = dict.fromkeys(COUNTS, 0)
        self._tls_failures: dict[str, int] = {}
        self._open: dict[int, _ServerRequest] = {}
        """The requests whose handlers are coroutines, by number."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._turns = asyncio.Lock()
        """Of large bodies."""
        self._is_flush_due = False
        """Whether responses of coroutines are about to be sent."""

    def counts(self) -> dict[str, int]:
        """Returns the counts of connections. Thread-safe. What is counted has been logged."""
        server = self._server
        if server is None:
            return self._counts
        counters = server.counters()
        self._log_events(server)
        return counters

    def tls_failures(self) -> dict[str, int]:
        """Returns the counts of failures of TLS, by reason. Thread-safe."""
        server = self._server
        return self._tls_failures if server is None else server.tls_failures()

    def run(self, stop: Stop) -> None:
        """Serves in this thread until `stop` is set. Can be called again: the socket stays open."""
        event_loop.run(self._serve(stop), event_loop.fastest)

    async def _serve(self, stop: Stop) -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._log_loop_error)
        stopped = asyncio.Event()
        self._turns = asyncio.Lock()
        stop.then(partial(tasks.call_soon, loop, stopped.set))
        server = self._server = self._new_server()
        try:
            wakes = socket.socket(fileno=server.detach())
            transport, _ = await loop.create_connection(
                lambda: _WakeSocket(lambda: self._take(server)), sock=wakes
            )
            server.start()
            while not stopped.is_set():
                self.heartbeat.beat()
                self._review(server)
                self._log_events(server)
                await tasks.within(PERIOD_S, stopped.wait())
            await self._end(server)
            transport.close()
        finally:
            server.close()
            self._counts, self._tls_failures = self.counts(), server.tls_failures()
            self._server = None

    def _new_server(self) -> HttpServer:
        limits, https = self.limits, self.https
        refused = {
            name: self.rejection(status, "malformed", text)
            for name, (status, text) in UNPARSED.items()
        }
        server = HttpServer(
            self.name,
            self.listener,
            sources=[str(source) for source in self.sources],
            max_connections=limits.max_connections,
            max_connections_per_source=limits.max_connections_per_source,
            when_full=limits.when_full,
            grace=EVICTION_GRACE_S,
            request_timeout=self.request_timeout,
            idle_timeout=KEEP_ALIVE_S,
            leaving=self.half_close_is_disconnect,
            tls=None if https is None else https.core,
            refusals=[(name, each.headers, each.body) for name, each in refused.items()],
        )
        if https is not None:
            https.follow(server.set_tls)
        return server

    def _review(self, server: HttpServer) -> None:
        """Judges the certificates of open connections again when it is time to."""
        review, now = 0.0 if self.https is None else self.https.review, time.monotonic()
        if review and now - self._last_review >= review:
            self._last_review = now
            server.review()

    async def _end(self, server: HttpServer) -> None:
        """Ends connections; those with a pending request after at most `stop_timeout` seconds."""
        server.end()
        deadline = time.monotonic() + self.stop_timeout
        while server.open and time.monotonic() < deadline:
            await asyncio.sleep(0.01)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _take(self, server: HttpServer) -> None:
        """Takes a batch of requests, and what has happened to others."""
        batches, events = server.take(REQUESTS_PER_BATCH)
        for batch in batches:
            second = [step for each in batch if (step := self._begin(each)) is not None]
            for step in second:
                step()
            server.flush()
        for number, kind, value in events:
            waiting = self._open.get(number)
            if waiting is not None:
                waiting.note(kind, value)
        if not batches and not events:
            self._log_events(server)

    def _begin(self, item: ParsedWrites | tuple[Any, ...]) -> Callable[[], None] | None:
        """Calls the handler. Returns its second step, if it has one."""
        if isinstance(item, ParsedWrites):
            return self._begin_parsed(item)
        request = _ServerRequest(self._turns, *item)
        try:
            outcome = self.handler(request)
        except Exception as error:
            outcome = self._failed(request, error)
        if isinstance(outcome, Response):
            self._respond(request, outcome)
            return None
        if callable(outcome):
            return partial(self._second_step, request, outcome)
        self._open[request.exchange.number] = request
        tasks.begin(self._answer(request, outcome), self._tasks)
        return None

    def _second_step(self, request: _ServerRequest, step: SecondStep) -> None:
        try:
            answer = step()
        except Exception as error:
            answer = self._failed(request, error)
        self._respond(request, answer)

    def _begin_parsed(self, writes: ParsedWrites) -> Callable[[], None]:
        """Calls the handler of writes that the core has parsed. It answers those it carries out."""
        carry_out: Callable[[], object] | None = None
        with self._logged():
            carry_out = writes.handler(writes)

        def second_step() -> None:
            with self._logged():
                if carry_out is not None:
                    carry_out()
            for each in writes.requests():
                if (step := self._begin(each)) is not None:
                    step()

        return second_step

    @contextlib.contextmanager
    def _logged(self) -> Iterator[None]:
        """Logs an error: what was not carried out then takes the way of other requests."""
        try:
            yield
        except Exception:
            log_lines.problem("request_failed", listener=self.name, peer="-")

    async def _answer(self, request: _ServerRequest, outcome: Awaitable[Response | None]) -> None:
        """Waits for the response of a handler, and sends it."""
        answer: Response | None = None
        try:
            answer = await outcome
        except ClientDisconnected:
            pass
        except Exception as error:
            answer = self._failed(request, error)
        finally:
            del self._open[request.exchange.number]
        if request.has_begun:
            # A stream can't become an error response any more: it is cut off.
            request.exchange.end(is_complete=answer is None)
        elif answer is not None:
            self._respond(request, answer)
            if not self._is_flush_due:
                # Requests that wait for the same thing are often answered in one turn of the loop.
                self._is_flush_due = True
                asyncio.get_running_loop().call_soon(self._flush)
        else:
            request.exchange.abandon()

    def _failed(self, request: Request, error: Exception) -> Response:
        """The response to a request whose handler has failed. Errors are logged."""
        if isinstance(error, BrokenBody):
            answer = self.rejection(400, "malformed", NOT_HTTP)
            answer.closes = True
            return answer
        log_lines.problem("request_failed", listener=self.name, peer=request.peer)
        return self.rejection(500, "internal_error", "internal error, see the log")

    def _respond(self, request: _ServerRequest, answer: Response) -> None:
        exchange = request.exchange
        exchange.respond(answer.status, answer.headers, answer.body, answer.closes)

    def _flush(self) -> None:
        self._is_flush_due = False
        if self._server is not None:
            self._server.flush()

    def _log_events(self, server: HttpServer) -> None:
        """Logs what has happened to connections. Thread-safe."""
        for event, fields in server.events():
            if event == "accept_error":
                self._log_fault("the system can't accept a connection", fields.get("error"))
            elif event != "secured":
                kind = (self.name, event, fields.get("reason"))
                log_lines.refused(event, kind=kind, listener=self.name, **fields)

    def _log_loop_error(self, loop: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:  # noqa: ARG002
        """Logs errors of the event loop."""
        error = context.get("exception")
        self._log_fault(context["message"], error and f"{type(error).__name__}: {error}")

    def _log_fault(self, message: str, error: str | None) -> None:
        log_lines.refused(
            "listener_fault",
            kind=self.name,
            listener=self.name,
            message=message,
            error=error or "-",
        )


COUNTS = (
    "accepted",
    "refused_source",
    "refused_full",
    "evicted",
    "idle",
    "request_timeout",
    "slow_reader",
    "broken_request",
    "tls_failed",
    "open",
)
"""Counts of connections: how many are `open`, and why others were refused or closed."""


class _WakeSocket(asyncio.BufferedProtocol):
    """The socket into which the core writes a byte when there is something to take."""

    def __init__(self, take: Callable[[], None]) -> None:
        self._take = take
        self._buffer = bytearray(64)

    def get_buffer(self, sizehint: int) -> bytearray:  # noqa: ARG002
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:  # noqa: ARG002
        self._take()


class _ServerRequest(Request):
    """A request from the core."""

    __slots__ = ("_is_gone", "_turns", "_waiter", "_when_gone", "exchange", "has_begun")

    def __init__(
        self,
        turns: asyncio.Lock,
        exchange: HttpExchange,
        head: tuple[str, str, bytes, str, Headers, dict[str, Any]],
        peer: str,
        length: int | None,
        whole: bytes | None,
        identity: tuple[str, str, str] | None,
    ) -> None:
        self.exchange = exchange
        self._turns = turns
        self.has_begun = False
        """Whether a stream has begun."""
        self._is_gone = False
        self._when_gone: Callable[[], object] | None = None
        self._waiter: asyncio.Future[tuple[str, Any]] | None = None
        method, path, query, version, headers, kept = head
        super().__init__(
            method,
            unquote(path) if "%" in path else path,
            query,
            headers,
            peer,
            version=version,
            whole=whole,
            length=length,
            identity=None if identity is None else Identity(*identity),
            kept=kept,
        )

    def note(self, kind: str, value: Any) -> None:
        """Hands an event of the core to the coroutine that waits for one."""
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result((kind, value))
        if kind == "gone":
            self._is_gone = True
            self._report_gone()

    async def receive(self, most: int) -> bytes:
        """Waits for the body, and for the turn of a large one."""
        body = await self._received(most)
        if len(body) > LARGE_BODY_BYTES:
            async with self._turns:
                await asyncio.sleep(0)  # The event loop does its other work before each of them.
        return body

    async def _received(self, most: int) -> bytes:
        self.exchange.receive(most)
        kind, value = await self._next()
        if kind == "body":
            return bytes(value)
        if kind == "late":
            raise BadRequest("timeout", f"the body is incomplete: {value} bytes arrived in time")
        if kind == "too_large":
            raise BadRequest("too_large", f"the body has more than {most} bytes")
        if kind == "broken":
            raise BrokenBody
        raise ClientDisconnected

    def when_gone(self, function: Callable[[], object] | None) -> None:
        """Sets the function to call when the client disconnects; `None` removes it."""
        self._when_gone = function
        if function is not None and not self.is_client_there():
            self._report_gone()

    def is_client_there(self) -> bool:
        """Whether the client is still connected. Thread-safe."""
        return not self._is_gone and self.exchange.watch_client()

    def _report_gone(self) -> None:
        """Calls the function of `when_gone` once."""
        function, self._when_gone = self._when_gone, None
        if function is not None:
            function()

    async def begin(self, status: int, headers: Headers) -> None:
        """Begins a stream."""
        self.has_begun = True
        self.exchange.begin(status, headers)

    async def send(self, data: bytes) -> None:
        """Sends a part of a stream when there is room for it."""
        while not (taken := self.exchange.send(data)):
            if taken is None:
                raise ClientDisconnected
            await self._next()

    async def end(self) -> None:
        """Ends a stream."""
        self.exchange.end(is_complete=True)

    async def _next(self) -> tuple[str, Any]:
        """Waits for the next event. Raises `ClientDisconnected` if the client is gone already."""
        if self._is_gone:
            raise ClientDisconnected
        self._waiter = asyncio.get_running_loop().create_future()
        try:
            return await self._waiter
        finally:
            self._waiter = None
