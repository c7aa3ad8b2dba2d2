"""How far apart tags may be to be read with one request."""

from __future__ import annotations

DEFAULT_MAX_GAP = 10
"""The largest gap between tags, in bits or registers, that is read with them by default."""
