"""A NATS client that survives malformed messages, and the bytes between it and its server.

The server forwards subjects with invalid UTF-8 or vertical tabs, and malformed headers. The parser
of nats-py stops at any of them, permanently or for some time. So this transport takes the messages
out of what the server sends, and the parser gets the other lines only.

TLS is the core's, and the certificate of a server is judged as that of a device.

It also notes what is known of the age of each message: NATS does not tell when one was sent. The
server answers pings in order, so what follows an answer was sent after the ping.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from nats.aio.client import DEFAULT_FLUSH_TIMEOUT, Client
from nats.aio.msg import Msg
from nats.aio.transport import TcpTransport
from nats.errors import Error, FlushTimeoutError, ProtocolError
from nats.protocol.parser import PERMISSIONS_ERR

from holdfast.events import log_lines
from holdfast.net.secure_channel import SecureChannel
from holdfast.net.tls import NO_FILES, Tls
from holdfast.runtime.backoff import Backoff
from holdfast.runtime.standstill import now

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection
    from urllib.parse import ParseResult

    from nats.aio.subscription import Subscription

END = b"\r\n"
CHUNK_BYTES = 65_536
PING, PONG = b"PING\r\n", b"PONG\r\n"
LOGIN = b"CONNECT "
CLOSE_TIMEOUT_S = 1.0
"""Seconds to send the last bytes of a connection that is closed."""

MAX_LINE_BYTES = 1024 * 1024
"""The longest line of the protocol in bytes. INFO lines are the longest."""

MAX_MESSAGE_BYTES = 64 * 1024 * 1024 + 65_536
"""The largest message in bytes: the most that `max_payload` of a server may be, and headers that
JetStream adds. The `max_payload` of one server says nothing about the messages of others, or of
those that are stored already."""

MAX_CLUSTER_SERVERS = 64
"""The most servers that are taken from the list of a cluster. Clusters have at most a dozen."""


CONNECTION_LOST = "the connection was lost"

FIRST_REPEAT_S, MAX_REPEAT_S = 10.0, 60.0
"""Seconds until refused subscriptions are repeated. Each time doubles them, up to the maximum."""


class ServerError(Error):
    """An error that the server reports and after which the connection goes on.

    It is that of a missing permission, with subjects as they are spelled.
    """

    @property
    def subject(self) -> str:
        """The subject that it names, as `as_quoted` has it; the server says it only in the text."""
        return str(self).partition('"')[2].rpartition('"')[0]

    def refuses_subscription(self, subject: str) -> bool:
        """Whether a subscription to this subject is refused, or has ended by that."""
        return f' Subscription to "{as_quoted(subject)}"' in str(self)


def as_quoted(subject: str) -> str:
    """A subject as in an error of the server, which quotes it."""
    return json.dumps(subject, ensure_ascii=False)[1:-1]


class _Head(NamedTuple):
    """The line before the bytes of a message."""

    subject: bytes
    sid: int
    reply: bytes
    header: int
    """Bytes of its headers."""
    size: int
    """Bytes of headers and payload."""


class MessageTransport(TcpTransport):
    """Calls `deliver` with the id of the subscription, subject, reply, payload and headers."""

    def __init__(
        self,
        deliver: Callable[[int, bytes, bytes, bytes, bytes], Awaitable[None]],
        heard: Callable[[], None],
        *,
        requires_tls: bool,
    ) -> None:
        """`heard` is called when the server has sent something.

        `requires_tls`: refuse a server without TLS before anything is sent to it. nats-py would
        continue without encryption.
        """
        super().__init__()  # type: ignore[no-untyped-call]
        self._deliver = deliver
        self._heard = heard
        self._requires_tls = requires_tls
        self._buffer = bytearray()
        self._head: _Head | None = None
        self._channel: SecureChannel | None = None
        self._early = b""
        """What was decrypted and is not read yet."""
        self._login = b""
        """The line of the client that begins a connection, until it is sent."""
        self.errors: deque[str] = deque()
        """The errors of the server that nats-py has not parsed yet: its parser changes the case."""
        self._pings: deque[tuple[float, bool]] = deque()
        """Times of pings without an answer, and whether the client does not know of them."""
        self.pinged = self.answered = -math.inf
        """When the last ping was sent, and the last one that was answered."""

    def __bool__(self) -> bool:
        return True  # nats-py replaces a transport that is false.

    @property
    def unsent(self) -> int:
        """Bytes that were not handed to the system."""
        assert self._io_writer is not None, "it was connected"
        return self._io_writer.transport.get_write_buffer_size()

    def ping(self) -> None:
        """Pings the server, without the knowledge of the client."""
        self._note_ping(hidden=True)
        self._send(PING)

    def _note_ping(self, *, hidden: bool) -> None:
        self.pinged = now()
        self._pings.append((self.pinged, hidden))

    async def connect(self, uri: ParseResult, buffer_size: int, connect_timeout: int) -> None:
        """Connects anew, after the end of the connection before."""
        # nats-py does not close a connection that the server refused, as for bad credentials.
        self.close()
        self._buffer.clear()
        self._head = None
        self._early = self._login = b""
        self.errors.clear()
        self._pings.clear()
        await super().connect(uri, buffer_size, connect_timeout)

    def close(self) -> None:
        """Closes the connection, if there is one."""
        channel, self._channel = self._channel, None
        if channel is not None:
            super().write(channel.end())  # type: ignore[no-untyped-call]
        super().close()  # type: ignore[no-untyped-call]

    async def wait_closed(self) -> None:
        """Waits until the connection is closed, but not for a server that takes no more bytes.

        What it has not taken is dropped: nats-py would otherwise never try another server.
        """
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await super().wait_closed()  # type: ignore[no-untyped-call]
        except TimeoutError:
            assert self._io_writer is not None, "it was connected"
            self._io_writer.transport.abort()

    async def connect_tls(
        self, uri: str | ParseResult, ssl_context: Any, buffer_size: int, connect_timeout: int
    ) -> None:
        """Begins TLS. `ssl_context` is a `Tls`; otherwise the system's authorities are trusted.

        Raises `OSError` for a server that is not trusted, and for unusable files.
        """
        files = ssl_context if isinstance(ssl_context, Tls) else NO_FILES
        host = uri if isinstance(uri, str) else str(uri.hostname)
        channel = SecureChannel(host, files)
        try:
            async with asyncio.timeout(connect_timeout):
                super().write(channel.outgoing())  # type: ignore[no-untyped-call]
                while not channel.is_ready:
                    self._early += await self._decrypted(channel, buffer_size)
        except BaseException:
            self.close()
            raise
        self._channel = channel

    async def _decrypted(self, channel: SecureChannel, buffer_size: int) -> bytes:
        data: bytes = await super().read(buffer_size)
        if not data:
            channel.check_lost()
            raise ConnectionResetError("the server closed the connection")
        try:
            return channel.receive(data)
        finally:
            super().write(channel.outgoing())  # type: ignore[no-untyped-call]

    def write(self, payload: bytes) -> None:
        """Sends bytes, and notes when a ping is sent.

        The login is sent with the ping that follows it: if the server has ended the connection, a
        second write would fail, and what it has said before would be lost.
        """
        if payload.startswith(LOGIN):
            self._login = payload
            return
        if payload == PING:
            self._note_ping(hidden=False)
        payload, self._login = self._login + payload, b""
        self._send(payload)

    def writelines(self, payload: list[bytes]) -> None:
        """Sends bytes."""
        self._send(b"".join(payload))

    def _send(self, data: bytes) -> None:
        if self._channel is not None:
            data = self._channel.encrypted(data)
        elif self._requires_tls:
            return  # nats-py flushes its buffer when it closes, even to a refused server.
        super().write(data)  # type: ignore[no-untyped-call]

    async def readline(self) -> bytes:
        """Returns one of the lines that begin a connection. Raises the error of a server."""
        line = await self._line()
        if line.startswith(b"-ERR"):
            raise Error(f"nats: {_error_text(line.removeprefix(b'-ERR'))}")
        if line.startswith(PONG):
            self._note_pong()
        elif line.startswith(b"INFO"):
            info = _decoded(line.removeprefix(b"INFO"))
            if self._requires_tls and not info.get("tls_required"):
                raise Error("the server does not use TLS")
            return _info_line(info)
        elif not line.startswith(b"+OK"):
            raise ProtocolError("nats: unknown protocol")
        return line

    async def _line(self) -> bytes:
        if self._channel is None:
            try:
                line: bytes = await super().readline()  # type: ignore[no-untyped-call]
            except ValueError:
                raise Error("nats: the server sent a line that is too long") from None
            return line
        while b"\n" not in self._early:
            if len(self._early) > MAX_LINE_BYTES:
                raise Error("nats: the server sent a line that is too long")
            self._early += await self._decrypted(self._channel, CHUNK_BYTES)
        line, end, self._early = self._early.partition(b"\n")
        return line + end

    async def _received(self, buffer_size: int) -> bytes:
        if self._channel is None:
            plain: bytes = await super().read(buffer_size)
            return plain
        early, self._early = self._early, b""
        return early or await self._decrypted(self._channel, buffer_size)

    async def read(self, buffer_size: int) -> bytes:
        """Delivers the messages that have arrived, and returns the other lines.

        Raises `ProtocolError` for malformed lines.
        """
        received = await self._received(buffer_size)
        if received:
            self._heard()
        self._buffer += received
        others = b""
        while self._buffer:
            if self._head is not None:
                if not await self._take_message(self._head):
                    break
                continue
            end = self._buffer.find(END)
            if end < 0:
                if len(self._buffer) > MAX_LINE_BYTES:
                    raise ProtocolError(f"nats: a line is longer than {MAX_LINE_BYTES} bytes")
                break
            line = bytes(self._buffer[:end])
            del self._buffer[: end + len(END)]
            others += self._take_line(line)
        return others

    async def _take_message(self, head: _Head) -> bool:
        """Delivers a message; returns false if it is not complete."""
        if len(self._buffer) < head.size + len(END):
            return False
        headers = bytes(self._buffer[: head.header])
        payload = bytes(self._buffer[head.header : head.size])
        del self._buffer[: head.size + len(END)]
        self._head = None
        await self._deliver(head.sid, head.subject, head.reply, payload, headers)
        return True

    def _take_line(self, line: bytes) -> bytes:
        """Returns the line in a form that nats-py parses; nothing for what it need not know.

        Words end at spaces and tabs only, as for the server.
        """
        word, _, rest = line.replace(b"\t", b" ").partition(b" ")
        if word in (b"MSG", b"HMSG"):
            self._head = _head(rest, with_header=word == b"HMSG")
        elif word == b"PING":
            return PING
        elif word == b"PONG":
            return b"" if self._note_pong() else PONG
        elif word == b"INFO":
            return _info_line(_decoded(rest))
        elif word == b"-ERR":
            text = _error_text(rest)
            self.errors.append(text)
            return b"-ERR '%b'" % text.encode() + END
        elif word != b"+OK":
            raise ProtocolError("nats: unknown protocol")
        return b""

    def _note_pong(self) -> bool:
        """Notes the PONG for the oldest ping. Returns whether to hide it from nats-py."""
        if not self._pings:
            return False
        self.answered, hidden = self._pings.popleft()
        return hidden


def _head(rest: bytes, *, with_header: bool) -> _Head:
    parts = [part for part in rest.split(b" ") if part]
    names = len(parts) - 1 - with_header
    try:
        subject, sid, *reply = parts[:names]
        header, size = map(_number, [b"0"] * (not with_header) + parts[names:])
        head = _Head(subject, _number(sid), b"".join(reply), header, size)
    except ValueError:
        raise ProtocolError("nats: malformed MSG") from None
    if not header <= size <= MAX_MESSAGE_BYTES:
        raise ProtocolError(f"nats: found a message of {size} bytes, {header} of them its headers")
    return head


def _number(digits: bytes) -> int:
    """Raises `ValueError` for anything but digits."""
    if not digits.isdigit():
        raise ValueError("not a number")
    return int(digits)


def _decoded(info: bytes) -> dict[str, Any]:
    try:
        found = json.loads(info)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise ProtocolError("nats: malformed INFO")
    if (urls := found.pop("connect_urls", None)) and isinstance(urls, list):
        found["connect_urls"] = [url for url in urls[:MAX_CLUSTER_SERVERS] if _is_url(url)]
    return found


def _is_url(url: object) -> bool:
    """Whether nats-py can use the address of another server."""
    try:
        return isinstance(url, str) and urlsplit(f"nats://{url}").port is not None
    except ValueError:
        return False


def _info_line(info: dict[str, Any]) -> bytes:
    return b"INFO " + json.dumps(info).encode() + END


def _error_text(rest: bytes) -> str:
    """The reason of an error as nats-py requires it: not empty, and in UTF-8."""
    text = " ".join(rest.decode(errors="backslashreplace").split()).strip("'")
    return text or "no reason given"


@dataclass
class Received(Msg):
    """A message, with times from `runtime.standstill.now`."""

    sent_after: float = -math.inf
    """When the last ping was sent that the server has answered before it sent the message."""
    received: float = field(default_factory=now)


class SafeClient(Client):
    """Skips malformed messages, and logs them with a limited rate. Messages are `Received`."""

    def __init__(self, *, requires_tls: bool = False) -> None:
        """`requires_tls`: refuse a server without TLS."""
        super().__init__()
        self.transport = MessageTransport(self._deliver, self._heard, requires_tls=requires_tls)
        self._transport = self.transport
        self.msg_class = self._with_age  # type: ignore[assignment]
        self.loss_reason = CONNECTION_LOST
        """Why the connection has ended: in the words of the server, if it has said so."""
        self._refused: set[int] = set()
        """The subscriptions that the server has refused or ended."""
        self._refused_again: set[int] = set()
        """Those that it has refused since they were last repeated."""
        self._has_refused = asyncio.Event()

    @property
    def has_stopped_reconnecting(self) -> bool:
        """Whether nats-py's reconnect task has ended without a connection."""
        task = self._reconnection_task
        return self.is_reconnecting and task is not None and task.done()

    async def connect(self, *args: Any, **options: Any) -> None:
        """Connects, and learns the limits of the account, which come after the first answer.

        A server that is mute from then on is found by pings. One that has ended the connection has
        said why, and `loss_reason` has it.
        """
        await super().connect(*args, **options)
        with contextlib.suppress(FlushTimeoutError):
            await self.flush(self.options["connect_timeout"])

    async def flush(self, timeout: int = DEFAULT_FLUSH_TIMEOUT) -> None:
        """Waits until the server has all that was sent, and has answered it.

        nats-py sends the ping that asks for this before what is still in its buffer.
        """
        if self.is_connected and self._pending_data_size > 0:
            self.transport.writelines(self._pending)
            self._pending, self._pending_data_size = [], 0
        await super().flush(timeout)

    async def drain_all(self, subscriptions: Collection[Subscription]) -> None:
        """Ends subscriptions, after the handlers were called for all that the server has sent."""
        for number, each in list(self._subs.items()):
            if each in subscriptions:
                await self._send_unsubscribe(number)
        # `drain` alone loses messages.
        await self.flush()
        for each in subscriptions:
            await each.drain()  # type: ignore[no-untyped-call]

    async def ping_unless_pinged(self, since: float) -> None:
        """Pings the server, unless a ping was sent at or after `since`."""
        if self.is_connected and self.transport.pinged < since:
            self.transport.ping()

    async def _process_err(self, err_msg: str) -> None:
        text = self.transport.errors.popleft()
        if PERMISSIONS_ERR not in err_msg:
            # nats-py ends the connection without a word of it.
            self.loss_reason = f"the server ended the connection: {text}"
            await super()._process_err(err_msg)
            return
        error = ServerError(f"nats: {text}")
        if not self._is_known(error):
            self._err = error
            await self._error_cb(error)

    def _is_known(self, error: ServerError) -> bool:
        """Whether it only repeats that subscriptions are refused. Notes which ones are."""
        subs = self._subs.items()
        named = {number for number, each in subs if error.refuses_subscription(each.subject)}
        is_known = bool(named) and named <= self._refused
        self._refused |= named
        self._refused_again |= named
        if named:
            self._has_refused.set()
        return is_known

    async def repeat_refused(self) -> None:
        """Repeats subscriptions that are refused, until it is cancelled: permissions may change."""
        while True:
            await self._has_refused.wait()
            pauses = Backoff(FIRST_REPEAT_S, MAX_REPEAT_S, jitter=True)
            while self._refused:
                await asyncio.sleep(pauses.failed())
                if self.is_connected:
                    with contextlib.suppress(Error, OSError):
                        await self._repeat()
            self._has_refused.clear()

    async def _repeat(self) -> None:
        """Repeats them once. What is refused again is so before the answer to the flush."""
        self._refused_again = set()
        for number in tuple(self._refused):
            if (subscription := self._subs.get(number)) is not None:
                await self._send_subscribe(subscription)
        await self.flush()
        self._refused = self._refused_again

    async def _process_pong(self) -> None:
        """Passes over the answer to a flush that was given up: nats-py would end its reading."""
        if self._pongs and self._pongs[0].done():
            del self._pongs[0]
        else:
            await super()._process_pong()

    async def _process_connect_init(self) -> None:
        self.loss_reason = CONNECTION_LOST
        await super()._process_connect_init()

    async def _process_info(self, info: dict[str, Any], initial_connection: bool = False) -> None:
        """Takes limits that have changed, which nats-py ignores, and the servers of the cluster in
        place of those listed before, which it keeps.
        """
        max_payload = info.get("max_payload")
        if type(max_payload) is int:  # `True` is one for `isinstance`.
            self._max_payload = max_payload
        if listed := info.get("connect_urls"):
            self._server_pool[:] = [
                each
                for each in self._server_pool
                if not each.discovered or each is self._current_server or each.uri.netloc in listed
            ]
        await super()._process_info(info, initial_connection)

    def _heard(self) -> None:
        """Resets nats-py's count of unanswered pings.

        Any data shows that the server is alive, even if its PONG is queued behind messages.
        """
        self._pings_outstanding = 0

    def _with_age(self, **parts: Any) -> Received:
        return Received(**parts, sent_after=self.transport.answered)

    async def _deliver(
        self, sid: int, subject: bytes, reply: bytes, payload: bytes, headers: bytes
    ) -> None:
        try:
            await self._process_msg(sid, subject, reply, payload, headers)
        except Exception as error:  # One malformed message must not stop the others.
            shown = subject.decode(errors="backslashreplace")
            log_lines.refused(
                "message_malformed", kind="nats", subject=shown, reason=_reason(error)
            )


def _reason(error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return "invalid UTF-8 in the subject, the reply subject or a header"
    return f"malformed headers ({type(error).__name__})"
