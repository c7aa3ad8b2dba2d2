"""The connection to NATS, and what goes over it."""

from __future__ import annotations

from holdfast.scanner.nats.connection import (
    ANSWERING,
    MAX_PAUSE,
    Broker,
    Ping,
    Servers,
    connected_once,
)
from holdfast.scanner.nats.outbox import Outbox
from holdfast.scanner.nats.tolerant_client import SafeClient

__all__ = [
    "ANSWERING",
    "MAX_PAUSE",
    "Broker",
    "Outbox",
    "Ping",
    "SafeClient",
    "Servers",
    "connected_once",
]
