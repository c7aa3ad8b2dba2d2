"""The one way by which Python code reads and writes memory: checks, counters, audit.

Nothing here knows HTTP or MQTT.
"""

from __future__ import annotations

from holdfast.ingest.memory_access import Counts, Grant, MemoryAccess, Refused, Written

__all__ = ["Counts", "Grant", "MemoryAccess", "Refused", "Written"]
