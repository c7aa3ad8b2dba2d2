"""What a configuration can be expected to hold one day, but not in this version.

It is refused by name, so that nobody takes it for served.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.listeners import LISTENER_TYPES
from holdfast.config.tolerance import mapping
from holdfast.config.words import choice

if TYPE_CHECKING:
    from holdfast.config.problems import Report

TYPES = ("modbus-tls",)


def refuse_unavailable(data: object, report: Report) -> None:
    """Reports what is not available, for nobody else to look at it."""
    for name, listener in mapping(mapping(data).get("listeners")).items():
        kind = mapping(listener).get("type")
        if isinstance(kind, str) and kind in TYPES:
            allowed = f"allowed: {choice(LISTENER_TYPES)}"
            message = f"{kind!r} is not available in this version, {allowed}"
            report.settle(("listeners", name), message, ("type",))
