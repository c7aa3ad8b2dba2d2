"""What callers can ask for at most. Without limits any of them could use up all memory."""

from __future__ import annotations

from dataclasses import dataclass

from holdfast.config.scanning import MAX_DEVICES, MAX_TAGS


@dataclass(frozen=True)
class ScannerLimits:
    """The limits of one scanner; times are in milliseconds."""

    devices: int = MAX_DEVICES
    tags: int = MAX_TAGS
    """Of all devices."""
    device_tags: int = 10_000
    """Of one device."""
    subscribers: int = 100
    """Of one device."""
    shortest_scan: int = 50
    longest_scan: int = 86_400_000
    shortest_timeout: int = 10
    longest_timeout: int = 30_000
    request: int = 4 * 1024 * 1024
    """Bytes of a request."""
    command: int = 4096
    """Bytes of the value of a command."""
    pending: int = 10_000
    """Requests that are carried out at once."""

    @property
    def connections(self) -> int:
        """The most connections to devices: one to each, and one beside it that is being closed."""
        return self.devices
