"""A NATS client that survives malformed messages, and notes what is known of their age."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from nats.aio.client import Client
from nats.aio.msg import Msg

from holdfast import logs
from holdfast.runtime.standstill import now
from holdfast.scanner.nats.transport import MessageTransport


@dataclass
class Received(Msg):
    """A message, with times of `now`."""

    sent_after: float = -math.inf
    """When the last ping was sent that the server has answered before it sent the message."""
    received: float = field(default_factory=now)


class SafeClient(Client):
    """Skips malformed messages, and logs them with a limited rate. Messages are `Received`."""

    def __init__(self, *, requires_tls: bool = False) -> None:
        """`requires_tls`: refuse a server without TLS."""
        super().__init__()
        self.transport = MessageTransport(self._deliver, requires_tls=requires_tls)
        self._transport = self.transport
        self.msg_class = self._with_age  # type: ignore[assignment]

    async def prove(self, since: float) -> None:
        """Pings the server, unless that was done after `since`."""
        if self.is_connected and self.transport.pinged < since:
            self.transport.ping()

    def _with_age(self, **parts: Any) -> Received:
        return Received(**parts, sent_after=self.transport.answered)

    async def _deliver(
        self, sid: int, subject: bytes, reply: bytes, payload: bytes, headers: bytes
    ) -> None:
        try:
            await self._process_msg(sid, subject, reply, payload, headers)
        except Exception as error:  # One malformed message must not stop the others.
            shown = subject.decode(errors="backslashreplace")
            logs.refused("message_malformed", kind="nats", subject=shown, reason=_reason(error))


def _reason(error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return "invalid UTF-8 in the subject, the reply subject or a header"
    return f"malformed headers ({type(error).__name__})"
