"""When a command to write comes too late."""

from __future__ import annotations

WRITE_TTL_S = 10.0
"""Seconds that a write may wait until it is sent; the poller adds one timeout of the device. Later,
nobody expects it any more."""
