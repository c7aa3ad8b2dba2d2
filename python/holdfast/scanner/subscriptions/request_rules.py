"""The rules for requests: limits, default values, and how strictly requests are checked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.config.values.scanner_settings import (
    DEFAULT_MAX_DEVICES,
    DEFAULT_MAX_TAGS,
    MAX_SCAN_RATE,
    MAX_TIMEOUT,
    MIN_SCAN_RATE,
    MIN_TIMEOUT,
    SCAN_RATE,
    TIMEOUT,
)
from holdfast.scanner.dialects import TENTACLE, Dialect
from holdfast.scanner.errors import Refused

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config.values.scanner_settings import Publish
    from holdfast.scanner.messages.decoding import Adjustments
    from holdfast.tags import TagList


@dataclass(frozen=True)
class ScannerLimits:
    """The limits of one scanner.

    Without limits, any caller could exhaust memory.
    """

    devices: int = DEFAULT_MAX_DEVICES
    tags: int = DEFAULT_MAX_TAGS
    """Tags of all devices together."""
    device_tags: int = 10_000
    """Tags of one device."""
    subscribers: int = 100
    """Subscribers of one device."""
    request: int = 4 * 1024 * 1024
    """Size of a request in bytes."""
    command: int = 4096
    """Size of the value of a command in bytes."""
    pending: int = 10_000
    """Pending requests."""


@dataclass(frozen=True)
class Defaults:
    """The values for keys that a subscribe request leaves out; times are in milliseconds."""

    timeout: int = TIMEOUT
    publish: Publish = "scan"
    deadband: float = 0.0
    """With `publish` `change` only."""
    scan_rate: int = SCAN_RATE


@dataclass(frozen=True)
class Rules:
    """The settings that a request is checked against."""

    limits: ScannerLimits = field(default_factory=ScannerLimits)
    defaults: Defaults = field(default_factory=Defaults)
    strict: bool = False
    """Whether a request is refused that would otherwise be adjusted, see `messages.decoding`."""
    dialect: Dialect = TENTACLE
    profiles: Mapping[str, TagList] = field(default_factory=dict)
    """The tags that requests can name by their profile."""

    def scan_rate(self, requested: int | None, adjustments: Adjustments) -> int:
        """Returns the scan rate of a request. Raises `Refused`.

        Unless the rules are strict, one that is too short is raised. Adds this to `adjustments`.
        """
        if requested is None:
            return self.defaults.scan_rate
        if requested < MIN_SCAN_RATE and not self.strict:
            raised = f"{requested} to {MIN_SCAN_RATE} ms"
            adjustments.changes.append(("scan_rate_raised", raised))
            return MIN_SCAN_RATE
        return _within("scanRate", requested, MIN_SCAN_RATE, MAX_SCAN_RATE)

    def timeout(self, requested: int | None) -> int:
        """Returns the timeout of a request. Raises `Refused`."""
        timeout = self.defaults.timeout if requested is None else requested
        return _within("timeout", timeout, MIN_TIMEOUT, MAX_TIMEOUT)


def _within(key: str, value: int, least: int, most: int) -> int:
    if not least <= value <= most:
        raise Refused(f"{key} is {value}, allowed: {least} to {most} ms")
    return value
