"""How requests are understood: what they leave out, and how strictly they are checked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.config.scanning import SCAN_RATE, TIMEOUT
from holdfast.scanner.messages.dialects import TENTACLE
from holdfast.scanner.subscriptions.limits import ScannerLimits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config.scanning import Publish
    from holdfast.scanner.messages.dialect import Dialect
    from holdfast.tags import TagList


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
    """Whether a request is refused that would otherwise be adjusted, see `messages.leniency`."""
    dialect: Dialect = TENTACLE
    profiles: Mapping[str, TagList] = field(default_factory=dict)
    """The tags that requests can name by their profile."""
