"""How far apart tags may be to be read with one request."""

from __future__ import annotations

DEFAULT_MAX_GAP = 10
"""The largest gap between tags, in bits or registers, that is read with them by default."""


def gap_of_device(*, has_reads: bool, has_tags: bool) -> int:
    """The default of a polled device. Its `reads` are joined only if the configuration says so."""
    return DEFAULT_MAX_GAP if has_tags and not has_reads else 0
