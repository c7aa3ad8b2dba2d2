"""A sender of Raw Ingest packets: one connection per packet, one atomic write, one reply byte.

`unit` selects packets of format v1, `memory_id` packets of format crc; use the format of the
receiver's configuration. Nothing is retried: the caller decides what to do after a failure.

>>> await holdfast.raw_ingest.send("10.0.2.9", 9000, "input_registers", 0, [100, 200], unit=1)
"""

from __future__ import annotations

from holdfast.net.tls import Tls
from holdfast.raw_ingest.encoding import encode
from holdfast.raw_ingest.outcome import RawError, RawRefused, RawTimeout, RawTlsFailed
from holdfast.raw_ingest.sending import TIMEOUT_S as TIMEOUT_S
from holdfast.raw_ingest.sending import send, send_packet, send_packet_sync, send_sync

__all__ = [
    "RawError",
    "RawRefused",
    "RawTimeout",
    "RawTlsFailed",
    "Tls",
    "encode",
    "send",
    "send_packet",
    "send_packet_sync",
    "send_sync",
]
