"""The only way for adapters to read and write memories: checks, counters and audit log.

This package does not know HTTP or MQTT.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast._core import Follower
    from holdfast.ingest.counts import Counts
    from holdfast.ingest.memory_access import Begun, Grant, MemoryAccess, Written
    from holdfast.ingest.refusals import REFUSED_FOR_NOW, Refused, unreadable
else:
    _ACCESS = ("Begun", "Grant", "MemoryAccess", "Written")
    _REFUSALS = ("REFUSED_FOR_NOW", "Refused", "unreadable")
    __getattr__ = imported_on_use(
        __name__,
        {
            "Counts": "holdfast.ingest.counts",
            "Follower": "holdfast._core",
            **dict.fromkeys(_ACCESS, "holdfast.ingest.memory_access"),
            **dict.fromkeys(_REFUSALS, "holdfast.ingest.refusals"),
        },
    )

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
