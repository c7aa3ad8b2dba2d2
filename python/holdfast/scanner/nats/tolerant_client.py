"""A NATS client that survives malformed messages.

The server forwards subjects with invalid UTF-8 or vertical tabs, and malformed headers. nats-py
stops receiving after any of them, permanently or for some time. This client skips such messages.

It also notes what is known of the age of each message: NATS does not tell when one was sent.
"""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from nats.aio.client import Client, Srv
from nats.aio.msg import Msg
from nats.errors import Error, ProtocolError
from nats.protocol.parser import AWAITING_CONTROL_LINE, AWAITING_MSG_PAYLOAD, Parser

from holdfast import logs
from holdfast.standstill import now

END = b"\r\n"
MAX_LINE = 1024 * 1024
"""The longest line of the protocol in bytes. INFO lines are the longest."""


@dataclass
class Received(Msg):
    """A message, with times of `now`."""

    sent_after: float = -math.inf
    """When the last ping was sent that the server has answered before it sent the message."""
    received: float = field(default_factory=now)


class SafeClient(Client):
    """Skips malformed messages, and logs them with a limited rate. Messages are `Received`."""

    msg_class = Received

    def __init__(self) -> None:
        super().__init__()
        self._ps = _Parser(self)
        self._pinged: WeakKeyDictionary[asyncio.Future[Any], float] = WeakKeyDictionary()
        self._last_ping = self._answered = -math.inf
        """When the last ping was sent, and the last one that was answered."""

    async def prove(self, since: float) -> None:
        """Pings the server, unless that was done after `since`."""
        if self.is_connected and self._last_ping < since:
            await self._send_ping()

    async def _connect_to_server(self, s: Srv) -> None:
        # A connection that was refused, such as for its credentials: nats-py would forget it open.
        if self._transport is not None:
            self._transport.close()  # type: ignore[no-untyped-call]
        await super()._connect_to_server(s)

    async def _process_connect_init(self) -> None:
        began = now()
        await super()._process_connect_init()
        self._last_ping = self._answered = began  # It has exchanged a ping.

    async def _send_ping(self, future: asyncio.Future[Any] | None = None) -> None:
        if future is None:
            future = asyncio.get_running_loop().create_future()
        self._pinged[future] = self._last_ping = now()
        await super()._send_ping(future)

    async def _process_pong(self) -> None:
        if self._pongs:
            self._answered = self._pinged.get(self._pongs[0], self._answered)
        await super()._process_pong()

    def _build_message(self, *parts: Any) -> Received:
        message: Received = super()._build_message(*parts)
        message.sent_after = self._answered
        return message

    async def _process_msg(
        self, sid: int, subject: bytes, reply: bytes, data: bytes, headers: bytes
    ) -> None:
        try:
            await super()._process_msg(sid, subject, reply, data, headers)
        except Exception as error:  # One malformed message must not stop the others.
            shown = subject.decode(errors="backslashreplace")
            logs.refused("message_malformed", kind="nats", subject=shown, reason=_reason(error))


class TlsClient(SafeClient):
    """Refuses a server without TLS. nats-py would continue without encryption."""

    async def _process_info(self, info: dict[str, Any], initial_connection: bool = False) -> None:
        if initial_connection and not info.get("tls_required"):
            raise Error("the server does not use TLS")
        await super()._process_info(info, initial_connection)


def _decoded(info: bytes) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(info)
    except ValueError:
        raise ProtocolError("nats: malformed INFO") from None
    return found


def _reason(error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return "invalid UTF-8 in the subject, the reply subject or a header"
    return f"malformed headers ({type(error).__name__})"


class _Parser(Parser):
    """Splits lines only at spaces and tabs, as the server does."""

    nc: Client

    async def parse(self, data: bytes = b"") -> None:
        """Handles all complete lines and messages. Raises `ProtocolError` for malformed lines."""
        self.buf.extend(data)
        while self.buf:
            if self.state == AWAITING_CONTROL_LINE:
                end = self.buf.find(END)
                if end < 0:
                    if len(self.buf) > MAX_LINE:
                        raise ProtocolError(f"nats: a line is longer than {MAX_LINE} bytes")
                    return
                line = bytes(self.buf[:end])
                del self.buf[: end + len(END)]
                await self._take(line)
            else:
                if len(self.buf) < self.needed + len(END):
                    return
                head = bytes(self.buf[: self.header_needed])
                payload = bytes(self.buf[self.header_needed : self.needed])
                del self.buf[: self.needed + len(END)]
                self.state = AWAITING_CONTROL_LINE
                of = self.msg_arg
                await self.nc._process_msg(of["sid"], of["subject"], of["reply"], payload, head)

    async def _take(self, line: bytes) -> None:
        """Handles one line."""
        word, _, rest = line.replace(b"\t", b" ").partition(b" ")
        if word in (b"MSG", b"HMSG"):
            self._begin(rest, with_header=word == b"HMSG")
        elif word == b"PING":
            await self.nc._process_ping()
        elif word == b"PONG":
            await self.nc._process_pong()
        elif word == b"INFO":
            await self.nc._process_info(_decoded(rest))
        elif word == b"-ERR":
            await self.nc._process_err(rest.decode(errors="backslashreplace").lower())
        elif word != b"+OK":
            raise ProtocolError("nats: unknown protocol")

    def _begin(self, rest: bytes, *, with_header: bool) -> None:
        """Parses the line before the bytes of a message."""
        parts = [part for part in rest.split(b" ") if part]
        try:
            subject, sid, *reply = parts[: len(parts) - 1 - with_header]
            sizes = [int(part) for part in parts[len(parts) - 1 - with_header :]]
            self.msg_arg = {"subject": subject, "sid": int(sid), "reply": b"".join(reply)}
        except ValueError:
            raise ProtocolError("nats: malformed MSG") from None
        self.header_needed, self.needed = sizes if with_header else (0, *sizes)
        self.state = AWAITING_MSG_PAYLOAD
