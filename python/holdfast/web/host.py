"""A host for ASGI applications: HTTP/1.1 with allowed source networks, limits and timeouts.

uvicorn and httptools implement the protocol. This module protects it from hostile and broken peers:
a peer from another network gets no byte, the number of connections is limited, receiving a request
and sending a reply have timeouts, and pipelined requests wait unparsed.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from dataclasses import asdict, dataclass
from email.utils import formatdate
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import httptools
import msgspec
import uvicorn
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.server import ServerState

from holdfast import logs
from holdfast.net.addresses import holds, joined, parse_address
from holdfast.net.closing import close
from holdfast.runtime.heartbeat import PERIOD, Heartbeat
from holdfast.web.admission import Admission, Full, Waiting
from holdfast.web.port import BACKLOG
from holdfast.web.tls import TlsTransport

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable, Iterable, Mapping, MutableMapping

    from holdfast.net.addresses import Network
    from holdfast.runtime.stop import Stop
    from holdfast.web.admission import ConnectionLimits
    from holdfast.web.https import Https

    Scope: TypeAlias = MutableMapping[str, Any]
    Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
    Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]
    App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]
    Headers: TypeAlias = list[tuple[bytes, bytes]]
    Rejection: TypeAlias = Callable[[str, str], tuple[Headers, bytes]]

MAX_HEADER = 65536
"""The largest request header in bytes; also the limit for chunk extensions and trailers."""

SLICE = 8192
"""Bytes that are parsed at a time. This bounds the number of pipelined requests in memory."""

KEEP_ALIVE = 60.0
"""Seconds after which an idle connection is closed."""

LATE_ANSWER_TIMEOUT = 1.0
"""Seconds for the application to answer a request that did not arrive in time."""

STOP_TIMEOUT = 3.0
"""Seconds for pending requests to finish when the host stops, by default. Longer than applications
need to end them, so that a loaded machine can still send the answers."""

SAFE: Headers = [(b"cache-control", b"no-store"), (b"x-content-type-options", b"nosniff")]
"""Headers of every response: no caching, no guessing of content types."""

# uvicorn's own log is discarded. This module logs events in the project's format.
logging.getLogger("uvicorn").addHandler(logging.NullHandler())
logging.getLogger("uvicorn").propagate = False


def address_of(host: str, port: int) -> str:
    """Formats `10.0.0.9:51200` or `[fd00::9]:51200`. An IPv4-mapped address is shown as IPv4."""
    return joined(str(parse_address(host)), port)


def rejection(reason: str, detail: str, status: str = "rejected") -> tuple[Headers, bytes]:
    """Returns the headers and the JSON of a refusal."""
    body = msgspec.json.encode({"status": status, "reason": reason, "detail": detail})
    return headers_of(b"application/json", body), body


def headers_of(kind: bytes, body: bytes) -> Headers:
    """Returns the headers of a response with this body."""
    return [(b"content-type", kind), (b"content-length", b"%d" % len(body)), *SAFE]


@dataclass
class Counts:
    """Counts of connections: how many are `open`, and why others were refused or closed."""

    accepted: int = 0
    refused_source: int = 0
    refused_full: int = 0
    evicted: int = 0
    idle: int = 0
    request_timeout: int = 0
    slow_reader: int = 0
    broken_request: int = 0
    tls_failed: int = 0
    open: int = 0


class BrokenBody(Exception):
    """The body of a request can't be parsed. Raised where the application receives it."""


class Host:
    """Serves one ASGI application on a listening socket.

    `scope["state"]["peer"]` is the peer's address as text, for logs. When a request does not arrive
    in time, `scope["state"]["late"]` is set and `receive` returns. The application then has
    `LATE_ANSWER_TIMEOUT` seconds to answer before the connection is dropped.

    `receive` raises `BrokenBody` if the body of the request is not valid HTTP. An application
    leaves the response to the host then.

    An application that sets `scope["state"]["leaving"]` gets a half-close as a disconnect.

    `rejection` creates the response to requests that never reach the application.

    With `https`, connections use TLS; the limits and `request_timeout` include the handshake.

    A peer that half-closes the connection still gets its responses. With `leaving`, a half-close
    means that the client is gone, because a full close looks the same to the server.
    """

    def __init__(
        self,
        name: str,
        app: App,
        listener: socket.socket,
        *,
        sources: Iterable[Network],
        limits: ConnectionLimits,
        request_timeout: float,
        stop_timeout: float = STOP_TIMEOUT,
        leaving: bool = False,
        rejection: Rejection = rejection,
        https: Https | None = None,
    ) -> None:
        self.name = name
        self.https = https
        self.rejection = rejection
        self.leaving = leaving
        self.request_timeout = request_timeout
        self._stop_timeout = stop_timeout
        self.sources = tuple(sources)
        self.counted = Counts()
        self._tls_failures: dict[str, int] = {}
        self.heartbeat = Heartbeat()
        """The heartbeat of the event loop of `run`."""
        host, port, *_ = listener.getsockname()
        self.address = address_of(host, port)
        self._limits = limits
        self._admission: Admission[_Connection] = Admission(limits)
        self._app = app
        self._listener = listener

    def counts(self) -> dict[str, int]:
        """Returns the counts of connections. Thread-safe."""
        return asdict(self.counted)

    def tls_failures(self) -> dict[str, int]:
        """Returns the counts of failures of TLS, by reason. Thread-safe."""
        return dict(self._tls_failures)

    def run(self, stop: Stop) -> None:
        """Serves in this thread until `stop` is set. Can be called again: the socket stays open."""
        asyncio.run(self._serve(stop))

    def admits(self, host: str) -> bool:
        """Returns whether a peer with this address may connect."""
        return holds(self.sources, parse_address(host))

    def has_room(self, connection: _Connection, host: str) -> bool:
        """Returns whether a connection has a place. Another one may have been evicted for it."""
        try:
            now = connection.loop.time()
            evicted = self._admission.admit(connection, parse_address(host), now)
        except Full:
            return False
        if evicted is not None:
            evicted.give_way()
        return True

    def release(self, connection: _Connection) -> None:
        """Frees the place of a connection that was closed."""
        self._admission.release(connection)

    def note_tls_failure(self, peer: str, reason: str) -> None:
        """Counts and logs a failure of TLS. Called in the thread of `run`."""
        self._tls_failures[reason] = self._tls_failures.get(reason, 0) + 1
        self.note("tls_failed", peer, reason=reason)

    def note(self, event: str, peer: str, **fields: str) -> None:
        """Counts and logs an event of a connection. Called in the thread of `run`."""
        setattr(self.counted, event, getattr(self.counted, event) + 1)
        if event != "idle":
            kind = (self.name, event, *fields.values())
            logs.refused(event, kind=kind, listener=self.name, peer=peer, **fields)

    async def _serve(self, stop: Stop) -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._fault)
        stopped = asyncio.Event()

        def end() -> None:
            with contextlib.suppress(RuntimeError):  # The loop of this run is already closed.
                loop.call_soon_threadsafe(stopped.set)

        stop.then(end)
        self.counted.open = 0
        self._admission = Admission(self._limits)
        state, connection = self.protocols(loop)
        with self._listener.dup() as listener:
            server = await loop.create_server(connection, sock=listener, backlog=BACKLOG)
            while not stopped.is_set():
                self.heartbeat.beat()
                state.default_headers = [(b"date", formatdate(usegmt=True).encode())]
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(stopped.wait(), PERIOD)
            await close(server)
            await _end(cast("set[_Connection]", state.connections), self._stop_timeout)

    def protocols(
        self, loop: asyncio.AbstractEventLoop
    ) -> tuple[ServerState, Callable[[], asyncio.Protocol]]:
        """Returns the open connections, and a function that makes the protocol of another one."""
        config = uvicorn.Config(
            self._guarded,
            interface="asgi3",
            ws="none",
            log_config=None,
            access_log=False,
            proxy_headers=False,
        )
        config.load()
        state = ServerState()

        def connection() -> asyncio.Protocol:
            https, made = self.https, _Connection(config, state, {}, loop, host=self)
            return made if https is None else TlsTransport(https.context, made)

        return state, connection

    async def _guarded(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Runs the application. Exceptions are logged, and answered without details."""

        async def receive_valid() -> MutableMapping[str, Any]:
            message = await receive()
            if "broken" in scope["state"]:
                raise BrokenBody
            return message

        try:
            await self._app(scope, receive_valid, send)
        except BrokenBody:
            self.note("broken_request", scope["state"]["peer"])
            status, detail = scope["state"]["broken"]
            headers, body = self.rejection("malformed", detail)
            with contextlib.suppress(RuntimeError):  # The response has begun and is cut off.
                await respond(send, status, [*headers, (b"connection", b"close")], body)
        except Exception:
            logs.problem("request_failed", listener=self.name, peer=scope["state"]["peer"])
            with contextlib.suppress(RuntimeError):  # The response has begun and is cut off.
                await respond(send, 500, *rejection("internal_error", "see the log", "failed"))

    def _fault(self, loop: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:  # noqa: ARG002
        """Logs errors of the event loop, such as no file descriptor for a new connection."""
        error = context.get("exception")
        logs.refused(
            "listener_fault",
            kind=self.name,
            listener=self.name,
            message=context["message"],
            error="-" if error is None else f"{type(error).__name__}: {error}",
        )


async def respond(send: Send, status: int, headers: Headers, body: bytes = b"") -> None:
    """Sends a complete response."""
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


async def _end(connections: set[_Connection], timeout: float) -> None:
    """Closes connections; those with a pending request after at most `timeout` seconds."""
    for connection in list(connections):
        connection.shutdown()
    deadline = time.monotonic() + timeout
    while connections and time.monotonic() < deadline:
        await asyncio.sleep(0.01)
    for connection in list(connections):
        connection.transport.abort()
    await asyncio.sleep(0)


class _Flow(FlowControl):
    """Flow control that does not read while received bytes are unparsed."""

    def __init__(self, connection: _Connection) -> None:
        super().__init__(connection.transport)
        self._connection = connection

    def resume_reading(self) -> None:
        if not self._connection.held:
            super().resume_reading()


class _Output:
    """The output of one response. Sends the header together with the first piece of the body."""

    def __init__(self, connection: _Connection) -> None:
        self._connection = connection
        self._transport = connection.transport
        self._cycle = connection.cycle
        self._header: bytes | None = None
        self.is_closing = self._transport.is_closing

    def write(self, data: bytes) -> None:
        """Writes data, but holds the header back until the body begins."""
        if self._header is None and self._cycle.response_started:
            self._header = data
        elif self._header:
            self._transport.write(self._header + data)
            self._header = b""
        else:
            self._transport.write(data)

    def close(self) -> None:
        """Closes the connection after what was written."""
        self.write(b"")
        self._transport.close()

    def end(self) -> None:
        """Ends the response."""
        self.write(b"")
        self._connection.on_response_complete()


class _Connection(HttpToolsProtocol):
    """One connection.

    Its responses do not depend on how the bytes of requests are cut: each request is answered
    before what is wrong behind it, and what follows the last one is ignored.

    It has three deadlines, `math.inf` when they don't apply: for the request to arrive, for the
    reply to be sent, and for the next request to begin. A deadline is at least `_step` away when it
    is set, and the one alarm goes off at least that often, so the deadlines need no own timers.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        host: Host,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self.host = host
        self.held = b""
        self._admitted = False
        self._ended = self._broken = False
        self._refusal: bytes | None = None
        self._is_last = self._over = False
        self._running: Any = None
        self._in_message = False
        self._in_header = False
        self._messages = 0
        self._unparsed = 0
        self._overhead = 0
        self._since = 0.0
        self._used = False
        self._step = min(host.request_timeout, KEEP_ALIVE)
        self._request_due = self._reply_due = self._idle_due = math.inf
        self._alarm: asyncio.TimerHandle | None = None

    # Called by the transport.

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Admits the peer, or drops it without sending a byte."""
        host, port, *_ = transport.get_extra_info("peername") or ("", 0)
        if not host:  # The peer has already disconnected.
            transport.abort()
            return
        peer = address_of(host, port)
        refusal = (
            "refused_source"
            if not self.host.admits(host)
            else "refused_full"
            if not self.host.has_room(self, host)
            else None
        )
        if refusal is not None:
            self.host.note(refusal, peer)
            transport.abort()
            return
        self._admitted = True
        self.host.counted.accepted += 1
        self.host.counted.open += 1
        super().connection_made(transport)
        self.app_state = {"peer": peer}
        transport.set_write_buffer_limits(high=0)  # At most one reply is buffered, with a timeout.
        self.flow = _Flow(self)
        self._since = self.loop.time()
        self._request_due = self._since + self.host.request_timeout
        self._set_alarm()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cleans up after a closed connection."""
        if not self._admitted:
            return
        self.host.counted.open -= 1
        self.host.release(self)
        if self._alarm is not None:
            self._alarm.cancel()
        self.held = b""
        super().connection_lost(exc)

    def begun(self) -> None:
        """Called with the first bytes of a peer, which may be those of a TLS handshake."""
        self._used = True

    def data_received(self, data: bytes) -> None:
        """Buffers and parses received bytes."""
        self.begun()
        if not (self._broken or self._over or self.transport.is_closing()):
            self.held += data
            self._parse()

    def eof_received(self) -> bool:  # type: ignore[override]
        """Handles a half-close: the peer may still wait for responses."""
        if self.host.leaving or (self._busy() and "leaving" in self.cycle.scope["state"]):
            return False
        self._ended = True
        whole = self._busy() and not self.cycle.more_body
        return bool(whole or self.pipeline or self.held)

    def pause_writing(self) -> None:
        """Called when the peer reads more slowly than replies are written."""
        super().pause_writing()
        self._since = self.loop.time()
        self._reply_due = self._since + self.host.request_timeout

    def resume_writing(self) -> None:
        """Called when all written bytes were sent."""
        self._since = self.loop.time()
        self._reply_due = math.inf
        super().resume_writing()

    def tls_failed(self, reason: str) -> None:
        """Called when TLS failed, before the connection is closed."""
        self.host.note_tls_failure(self.app_state["peer"], reason)

    def plain_answer(self) -> bytes:
        """Returns the response to a request without TLS."""
        return self._refused(400, "this port takes HTTPS: use a URL that begins with https://")

    # Called by the parser.

    def on_message_begin(self) -> None:
        """Called at the start of a request."""
        if self._over:
            raise httptools.HttpParserError("a request behind the last one")
        self._in_message = self._in_header = True
        super().on_message_begin()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Called for each header. Trailers, which follow the body, are ignored."""
        if self._in_header:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Called after the header of a request; starts the application."""
        if self.parser.get_http_version() not in ("1.1", "1.0"):
            raise httptools.HttpParserError("unsupported HTTP version")
        self._overhead = 0
        super().on_headers_complete()
        self._in_header = False
        self._is_last = not self.cycle.keep_alive
        output = _Output(self)
        self.cycle.transport = cast("asyncio.Transport", output)
        self.cycle.on_response = output.end

    def on_body(self, body: bytes) -> None:
        """Called for each piece of the body."""
        self._overhead = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Called at the end of a request.

        With an Upgrade header the parser stops before the body, which is then read here.
        """
        if self.parser.should_upgrade():
            headers = dict(self.headers)
            if b"transfer-encoding" in headers:
                raise httptools.HttpParserError("chunked body with Upgrade")
            self._unparsed = int(headers.get(b"content-length", 0))
        if not self._unparsed:
            self._complete()

    def _complete(self) -> None:
        self._in_message = False
        self._over = self._is_last
        self._messages += 1
        self._overhead = 0
        super().on_message_complete()

    # Called by the application.

    def on_response_complete(self) -> None:
        """Called after a response: the next request starts, or the connection becomes idle."""
        self.server_state.total_requests += 1
        if self.transport.is_closing():
            return
        if self._broken and not self.pipeline:
            self._conclude()
            return
        if self.pipeline:
            self._start_asgi_task(*self.pipeline.pop())
        if self.held:
            self._parse()
        if not self.held and not self.pipeline:
            self.flow.resume_reading()
        self._settle()

    def _settle(self) -> None:
        """Starts the idle deadline, or closes the connection, when no request is pending."""
        if self._busy() or self._request_due != math.inf or self.transport.is_closing():
            return
        if self._ended:
            self.transport.close()
        else:
            self._since = self.loop.time()
            self._idle_due = self._since + KEEP_ALIVE

    def _busy(self) -> bool:
        """Returns whether a request waits for its response."""
        return self.cycle is not None and not self.cycle.response_complete

    def _parse(self) -> None:
        """Parses slice after slice until a pipelined request has to wait."""
        whole, at, messages = memoryview(self.held), 0, self._messages
        self._idle_due = math.inf
        if self._request_due == math.inf:
            self._since = self.loop.time()
            self._request_due = self._since + self.host.request_timeout
        while at < len(whole) and not (self.pipeline or self._broken or self._over):
            at += self._take(whole[at : at + SLICE])
        self.held = b"" if self._broken or self._over else bytes(whole[at:])
        if self.held:
            self.flow.pause_reading()
        if self._broken or self._messages != messages:
            more = self._in_message and not self._broken
            self._since = self.loop.time()
            self._request_due = self._since + self.host.request_timeout if more else math.inf
        self._settle()

    def _take(self, piece: memoryview) -> int:
        """Parses a slice. Returns the number of bytes that were consumed."""
        if self._unparsed:
            body = bytes(piece[: self._unparsed])
            self._unparsed -= len(body)
            self.on_body(body)
            if not self._unparsed:
                self._complete()
            return len(body)
        self._overhead += len(piece)
        try:
            self.parser.feed_data(piece)
        except httptools.HttpParserUpgrade as upgrade:  # The parser stops at the body.
            return int(upgrade.args[0])
        except httptools.HttpParserError:
            if not self._over:
                self._refuse(400, "not an HTTP request")
        else:
            if self._overhead > MAX_HEADER:
                self._refuse(431, f"the header has more than {MAX_HEADER} bytes")
        return len(piece)

    def _start_asgi_task(self, cycle: Any, app: Any) -> None:
        self._running = cycle
        super()._start_asgi_task(cycle, app)

    def _refuse(self, status: int, detail: str) -> None:
        """Refuses what can no longer be parsed, after the responses to the requests before it."""
        self._broken = True
        if not self._in_message or self._in_header:
            self._refusal = self._refused(status, detail)
        else:  # The application may respond without the body, whether it runs already or not.
            self.cycle.scope["state"]["broken"] = status, detail
            self.cycle.message_event.set()
        self._conclude()

    def _conclude(self) -> None:
        """Closes a broken connection when all requests before were answered."""
        is_answering = self._running is not None and not self._running.response_complete
        if is_answering or self.pipeline or self.transport.is_closing():
            return
        self.host.note("broken_request", self.app_state["peer"])
        if self._refusal is not None:
            self.transport.write(self._refusal)
        self.transport.close()

    def _refused(self, status: int, detail: str) -> bytes:
        headers, body = self.host.rejection("malformed", detail)
        all_headers = [*self.server_state.default_headers, *headers, (b"connection", b"close")]
        lines = [b"%b: %b\r\n" % header for header in all_headers]
        return b"".join([STATUS_LINE[status], *lines, b"\r\n", body])

    # A limit is reached.

    def waiting(self) -> Waiting | None:
        """Returns what it waits for; `None` while its request is answered, and the peer reads."""
        taken = self._reply_due == math.inf
        if self._busy() and taken and (self.cycle.response_started or not self.cycle.more_body):
            return None
        between_requests = taken and self._idle_due != math.inf
        return Waiting(self._used and not between_requests, self._since)

    def give_way(self) -> None:
        """Closes the connection for a new one."""
        self.host.note("evicted", self.app_state["peer"])
        if self._reply_due == math.inf and not self._in_message:
            self.transport.close()
        else:
            self.transport.abort()

    # Deadlines.

    def _set_alarm(self) -> None:
        now = self.loop.time()
        due = min(self._request_due, self._reply_due, self._idle_due, now + self._step)
        self._alarm = self.loop.call_at(due, self._look)

    def _look(self) -> None:
        """Closes the connection when a deadline has passed."""
        now = self.loop.time()
        peer = self.app_state["peer"]
        if self._reply_due <= now:
            self.host.note("slow_reader", peer)
            self.transport.abort()
        elif self._request_due <= now and self.flow.read_paused:  # The peer waits for the server.
            self._request_due = now + self.host.request_timeout
        elif self._request_due <= now:
            self._be_late()
        elif self._idle_due <= now:
            self.host.note("idle", peer)
            self.transport.close()
        self._set_alarm()

    def _be_late(self) -> None:
        """Lets the application answer if it waits for the body; otherwise drops the connection."""
        cycle = self.cycle
        if self.transport.get_extra_info("handshaking", False):
            self.tls_failed("timeout")
            self.transport.abort()
        elif not (self._busy() and cycle.more_body) or self.pipeline:
            self.host.note("request_timeout", self.app_state["peer"])
            self.transport.abort()
        elif "late" in cycle.scope["state"]:
            self.transport.abort()
        else:
            self.host.note("request_timeout", self.app_state["peer"])
            cycle.scope["state"]["late"] = True
            cycle.message_event.set()
            self._request_due = self.loop.time() + LATE_ANSWER_TIMEOUT
