"""When a command to write comes too late."""

from __future__ import annotations

WRITE_TTL_S = 10.0
"""Seconds that a write may wait to be sent; one timeout of its device is added. Later, nobody
expects it any more."""
