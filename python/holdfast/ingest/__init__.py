"""The only way for adapters to read and write memories: checks, counters and audit log.

This package does not know HTTP or MQTT.
"""

from __future__ import annotations

from holdfast._core import Follower
from holdfast.ingest.counts import Counts
from holdfast.ingest.memory_access import Begun, Grant, MemoryAccess, Written
from holdfast.ingest.refusals import REFUSED_FOR_NOW, Refused, unreadable

__all__ = [
    "REFUSED_FOR_NOW",
    "Begun",
    "Counts",
    "Follower",
    "Grant",
    "MemoryAccess",
    "Refused",
    "Written",
    "unreadable",
]
