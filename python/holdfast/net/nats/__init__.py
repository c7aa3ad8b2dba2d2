"""The connection to NATS, and what goes over it."""

from __future__ import annotations

from holdfast.net.nats.connection import (
    ANSWERING,
    MAX_PAUSE,
    Broker,
    Ping,
    Servers,
    connected_once,
    nats_reason,
)
from holdfast.net.nats.outbox import Outbox
from holdfast.net.nats.tolerant_client import SafeClient

__all__ = [
    "ANSWERING",
    "MAX_PAUSE",
    "Broker",
    "Outbox",
    "Ping",
    "SafeClient",
    "Servers",
    "connected_once",
    "nats_reason",
]
