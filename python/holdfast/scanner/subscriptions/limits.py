"""The limits for requests. Without limits, any caller could exhaust memory."""

from __future__ import annotations

from dataclasses import dataclass

from holdfast.config.scanning import (
    MAX_DEVICES,
    MAX_SCAN_RATE,
    MAX_TAGS,
    MAX_TIMEOUT,
    MIN_SCAN_RATE,
    MIN_TIMEOUT,
)


@dataclass(frozen=True)
class ScannerLimits:
    """The limits of one scanner; times are in milliseconds."""

    devices: int = MAX_DEVICES
    tags: int = MAX_TAGS
    """Tags of all devices together."""
    device_tags: int = 10_000
    """Tags of one device."""
    subscribers: int = 100
    """Subscribers of one device."""
    shortest_scan: int = MIN_SCAN_RATE
    longest_scan: int = MAX_SCAN_RATE
    shortest_timeout: int = MIN_TIMEOUT
    longest_timeout: int = MAX_TIMEOUT
    request: int = 4 * 1024 * 1024
    """Size of a request in bytes."""
    command: int = 4096
    """Size of the value of a command in bytes."""
    pending: int = 10_000
    """Pending requests."""

    @property
    def connections(self) -> int:
        """The most connections to devices: one to each, and one beside it that is being closed."""
        return self.devices
