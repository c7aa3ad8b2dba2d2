"""Which refusals besides those of writes the audit log has, and how many lines they get.

A refused write has a line of its own.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, cast

from holdfast.events.throttle import Origin, Throttle
from holdfast.protocol import OF_CODE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

# The time in which refusals of one kind and origin have one line, after that of the first.
INTERVAL_S = 600.0

# The kinds and origins of refusals that are distinguished in an interval.
MAX_ORIGINS = 250

# The subjects of one source that are distinguished in an interval.
MAX_SUBJECTS_OF_SOURCE = 16

# The fields that the refusals of a kind have in common.
KIND = ("listener", "adapter", "reason", "role")

# Refused connections and failed handshakes.
CONNECTIONS = ("refused_source", "refused_full", "refused_role", "tls_failed")

# Refused requests of listeners. All but refused_listen_only are reported once for each connection.
REQUESTS = ("refused_function", "refused_unit", "refused_address", "refused_listen_only")

# Requests over HTTP from somebody without the right.
DENIALS = {
    ("ingest_refused", "unauthorized"),
    ("ingest_refused", "not_granted"),
    ("ingest_refused", "foreign_page"),
    ("gateway_refused", "unauthorized"),
    ("gateway_refused", "refused_target"),
    ("gateway_refused", "writes_off"),
    ("gateway_refused", "foreign_page"),
}


class Refusals:
    """The refusals for the audit log, with one line for all of a kind and origin in an interval.

    The first refusal is a line at once, the others are one line at the end of the interval. So
    whoever is refused can't fill a disk, or push other lines out of the file. Thread-safe.
    `note` does not wait.
    """

    def __init__(self, interval: float = INTERVAL_S) -> None:
        self._counts = Throttle(
            burst=0, window=interval, most=MAX_ORIGINS, of_source=MAX_SUBJECTS_OF_SOURCE
        )
        self._first: deque[dict[str, object]] = deque()

    def note(self, event: str, fields: Mapping[str, object], by: Origin, times: int = 1) -> None:
        """Counts a refusal, if it is one that the audit log has. See `log_lines.observe`."""
        if not _is_audited(event, fields):
            return
        kind = (("event", event), *((key, fields[key]) for key in KIND if key in fields))
        is_first, before = self._counts.admit(kind, time.monotonic(), by, times)
        if is_first:
            if before:
                self._first.append(_line((kind, by, before)))
            self._first.append({"event": event, **fields, "count": 1})

    def take(self) -> list[dict[str, object]]:
        """Returns the lines that are due."""
        return [*self._taken(), *map(_line, self._counts.over(time.monotonic()))]

    def rest(self) -> list[dict[str, object]]:
        """Returns the lines of all refusals, also before the end of the interval."""
        return [*self._taken(), *map(_line, self._counts.rest())]

    def _taken(self) -> Iterator[dict[str, object]]:
        while self._first:
            yield self._first.popleft()


def _is_audited(event: str, fields: Mapping[str, object]) -> bool:
    if event in REQUESTS:
        function = OF_CODE.get(cast("int", fields.get("function")))
        # A write has a line of its own: crates/engine/src/server/reports/audit.rs.
        return function is None or not function.writes
    return event in CONNECTIONS or (event, fields.get("reason")) in DENIALS


def _line(counted: tuple[object, Origin, int]) -> dict[str, object]:
    kind, by, count = counted
    return {**dict(cast("Iterable[tuple[str, object]]", kind)), **by.fields(), "count": count}
