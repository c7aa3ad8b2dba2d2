"""When a command to write comes too late."""

from __future__ import annotations

WRITE_TTL_S = 10.0
"""Seconds that a write may wait for its device, but for one timeout of that. Later, nobody expects
it any more."""
