"""The options of listeners, as the core takes them, and their defaults.

Each listener is a mapping with all keys of its kind. `Server` and configurations fill it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypedDict

if TYPE_CHECKING:
    from holdfast._core import Listener, ServerTls
    from holdfast.types import Framing, WhenFull


class ServerOptions(TypedDict, total=False):
    """What a server on connections has beside its address and rules. Times are in seconds."""

    max_connections: int
    """The most open connections."""
    max_connections_per_source: int | None
    """The most open connections from one address. `None`: unlimited."""
    when_full: WhenFull
    """At the limit: `refuse` closes the new connection, `evict` the one that is idle longest."""
    idle_timeout: float
    """The time without a request; 0 is unlimited."""
    request_timeout: float
    """From the first byte of a request to its last, and for a peer to read its replies."""
    frame_timeout: float
    """RTU over TCP: the time without a byte after which an incomplete request is discarded."""
    keepalive: int
    """The time without a byte after which TCP asks whether the peer is still there. Whole seconds,
    1 to 32767."""
    listen_only: bool
    """Function 8 may set a unit to listen only mode, for all peers."""
    event_log: bool
    """Function 12 answers with the latest events of this server."""
    tls: ServerTls | None
    """The certificates; `None` is plain TCP."""


class StreamOptions(ServerOptions):
    """A listener for Modbus over connections."""

    framing: Framing
    max_handshakes: int
    """With TLS: the most connections that are not authenticated yet, beside `max_connections`."""
    raw_ingest: Listener | None
    """Packets on the same port, with `mbap` and without TLS; its bind and limits are ignored."""


class DatagramOptions(TypedDict):
    """A listener for Modbus over UDP."""

    framing: Literal["mbap", "rtu"]
    listen_only: bool
    event_log: bool


class SerialOptions(TypedDict):
    """A listener on a serial line."""

    mode: Literal["rtu", "ascii"]
    baud: int
    parity: Literal["none", "even", "odd"]
    stop_bits: int
    data_bits: int
    silence: float | None
    """The seconds of silence that end an RTU frame; `None` is 3.5 characters."""
    rs485: Literal["rts", "rts-low"] | None
    """The driver switches the direction of the line by RTS, which is high or low while sending."""
    event_log: bool


class RawIngestOptions(TypedDict):
    """A listener for Raw Ingest packets. Limits and times are those of `ServerOptions`."""

    format: Literal["v1", "crc"]
    crc: Literal["required", "none"]
    """`none`: packets end with their payload."""
    flags: Literal["strict", "ignore"]
    """`ignore`: flags and the reserved byte may have any value."""
    max_connections: int
    max_connections_per_source: int | None
    when_full: WhenFull
    request_timeout: float
    packets: Literal["one", "many"]
    """`many`: until the sender closes, one is refused, or none comes for `idle_timeout`."""
    idle_timeout: float
    after_refusal: Literal["close", "continue"]
    """`continue`: only an invalid header or CRC ends the connection."""
    tls: ServerTls | None
    max_handshakes: int | None


DEFAULTS: ServerOptions = {
    "max_connections": 256,
    "max_connections_per_source": None,
    "when_full": "refuse",
    "idle_timeout": 300.0,
    "request_timeout": 10.0,
    "frame_timeout": 0.05,
    "keepalive": 60,
    "listen_only": False,
    "event_log": False,
    "tls": None,
}

STREAM_DEFAULTS: StreamOptions = {
    **DEFAULTS,
    "framing": "mbap",
    "max_handshakes": 256,
    "raw_ingest": None,
}

RAW_INGEST_DEFAULTS: RawIngestOptions = {
    "format": "v1",
    "crc": "required",
    "flags": "strict",
    "max_connections": DEFAULTS["max_connections"],
    "max_connections_per_source": None,
    "when_full": DEFAULTS["when_full"],
    "request_timeout": DEFAULTS["request_timeout"],
    "packets": "one",
    "idle_timeout": DEFAULTS["idle_timeout"],
    "after_refusal": "close",
    "tls": None,
    "max_handshakes": None,
}
