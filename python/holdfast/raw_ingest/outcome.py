"""The outcome of one packet: written, refused, or unknown."""

from __future__ import annotations

import math
import reprlib

from holdfast.client.async_transports import explained
from holdfast.net.addresses import joined
from holdfast.net.hosts import is_host
from holdfast.raw_ingest.encoding import checked_field

DONE, REFUSED = b"\x00", b"\x01"


class RawError(Exception):
    """The packet was not confirmed.

    `maybe_written`: the whole packet was sent, but no valid reply arrived.
    """

    def __init__(self, what: str, maybe_written: bool) -> None:
        # Not by the constructor: `OSError` takes two arguments for an errno and its text.
        super().__init__()
        self.args = what, maybe_written
        self.what = what
        self.maybe_written = maybe_written

    def __str__(self) -> str:
        outcome = "the packet may have been written"
        return f"{self.what}; {outcome if self.maybe_written else 'nothing was written'}"


class RawRefused(RawError):
    """The receiver refused the packet (reply 01) and wrote nothing. It gives no reason."""


class RawTimeout(RawError, TimeoutError):
    """Connection, packet and reply took longer than the timeout."""


class RawTlsFailed(RawError):
    """TLS failed. `reason` is a word from docs/modbus-tls.md, such as `expired` or `wrong_name`."""

    def __init__(self, what: str, reason: str, maybe_written: bool) -> None:
        super().__init__(what, maybe_written)
        self.args = what, reason, maybe_written
        self.reason = reason


class TlsLost(OSError):
    """TLS has failed; the connection ended. `maybe_sent`: the peer may have executed the packet."""

    def __init__(self, reason: str, text: str, maybe_sent: bool) -> None:
        super().__init__(text)
        self.reason = reason
        self.maybe_sent = maybe_sent


class Attempt:
    """The progress of one packet, and its outcome."""

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.port = checked_field("port", port, least=1)
        refusal = f"timeout is {timeout!r}, allowed: more than 0 seconds"
        try:
            is_time = 0 < timeout < math.inf
        except TypeError:
            raise TypeError(refusal) from None
        if not is_time:
            raise ValueError(refusal)
        self.timeout = float(timeout)
        if not is_host(host):
            raise ValueError(f"{reprlib.repr(host)} is not a host name")
        self.peer = joined(host, self.port)
        self.connected = False
        self.sent = False

    def failed(self, error: OSError) -> RawError:
        """Converts an error of the connection."""
        if isinstance(error, TimeoutError):
            what = "reply" if self.connected else "connection"
            text = f"{self.peer}: no {what} within {self.timeout:g} s"
            return RawTimeout(text, maybe_written=self.sent)
        if isinstance(error, TlsLost):
            written = error.maybe_sent and self.sent
            return RawTlsFailed(f"{self.peer}: {error}", error.reason, maybe_written=written)
        return RawError(f"{self.peer}: {explained(error)}", maybe_written=self.sent)

    def conclude(self, reply: bytes) -> None:
        """Returns if the reply confirms the packet; otherwise raises `RawError`."""
        if reply == DONE and self.sent:
            return
        if reply == REFUSED:
            raise RawRefused(f"{self.peer} refused the packet", maybe_written=False)
        if reply == DONE:
            what = "answered 00 before it had the whole packet"
        elif reply:
            what = f"answered {reply.hex()}, allowed: 00 or 01"
        else:
            what = "closed the connection without a reply"
        raise RawError(f"{self.peer} {what}", maybe_written=self.sent)
