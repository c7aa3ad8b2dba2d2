"""What a configuration can be expected to hold one day, but not in this version.

It is refused by name, so that nobody takes it for served.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.tolerance import mapping

if TYPE_CHECKING:
    from holdfast.config.problems import Report

SECTIONS = ("nats", "gateway")


def refuse_unavailable(data: object, report: Report) -> None:
    """Reports what is not available, for nobody else to look at it."""
    for name in SECTIONS:
        if name in mapping(data):
            message = "this section is not available in this version"
            report.settle((name,), message, of_key=True)
