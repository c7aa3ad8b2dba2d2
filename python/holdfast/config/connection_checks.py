"""Checks the limits on connections of a listener, or of REST."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.lenient import integer
from holdfast.config.scalars import MAX_CONNECTIONS

if TYPE_CHECKING:
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


def doubt_source_limit(
    path: KeyPath, settings: dict[Any, Any], default: int, report: Report
) -> None:
    """Warns about a limit for one source that is above the limit for all."""
    most = integer(settings.get("max_connections", default), 1, MAX_CONNECTIONS)
    of_source = integer(settings.get("max_connections_per_source"), 1, MAX_CONNECTIONS)
    if most is not None and of_source is not None and of_source > most:
        message = f"{of_source} has no effect: max_connections is {most}"
        report.doubt((*path, "max_connections_per_source"), message)
