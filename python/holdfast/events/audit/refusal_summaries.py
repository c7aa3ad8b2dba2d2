"""Which refusals the audit log has, and how many lines they get.

Of refused writes, the first ones have whole lines. All others are counted.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, cast

from holdfast.events.throttle import OTHERS, Origin, Throttle, origin
from holdfast.protocol import OF_CODE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

# The time in which refusals of one kind and origin have one line, after that of the first.
INTERVAL_S = 600.0

# The kinds and origins of refusals that are distinguished in an interval.
MAX_ORIGINS = 250

# The subjects of one source that are distinguished in an interval.
MAX_SUBJECTS_OF_SOURCE = 16

# The refused writes of a listener that have whole lines in an interval, for each reason. The first
# one of each origin has one in any case.
WHOLE_WRITES = 20

# A number of refused writes.
WRITES = "refused_write"

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
    `note` and `has_line` do not wait.
    """

    def __init__(self, interval: float = INTERVAL_S) -> None:
        self._counts, self._writes = (
            Throttle(burst, interval, MAX_ORIGINS, MAX_SUBJECTS_OF_SOURCE)
            for burst in (0, WHOLE_WRITES)
        )
        self._first: deque[dict[str, object]] = deque()

    def note(self, event: str, fields: Mapping[str, object], by: Origin, times: int = 1) -> None:
        """Counts a refusal, if it is one that the audit log has. See `log_lines.observe`."""
        if _is_audited(event, fields):
            self._note(event, fields, by, times)

    def _note(self, event: str, fields: Mapping[str, object], by: Origin, times: int) -> None:
        kind = (("event", event), *((key, fields[key]) for key in KIND if key in fields))
        is_first, before = self._counts.admit(kind, time.monotonic(), by, times)
        if is_first:
            if before:
                self._first.append(_line((kind, by, before)))
            self._first.append({"event": event, **fields, "count": 1})

    def has_line(self, write: Mapping[str, object], times: int = 1) -> bool:
        """Counts a refused write that occurred several `times`. Returns whether to log it."""
        kind = (("event", WRITES), *((key, write[key]) for key in ("listener", "outcome")))
        by = origin(WRITES, write)
        is_whole, before = self._writes.admit(kind, time.monotonic(), by, times)
        if is_whole and before:
            self._first.append(_line((kind, by, before)))
        return is_whole

    def note_others(self, times: int) -> None:
        """Counts refused writes of which nothing else is known."""
        self._note(WRITES, {"peer": OTHERS}, Origin(OTHERS), times)

    def take(self) -> list[dict[str, object]]:
        """Returns the lines that are due."""
        now = time.monotonic()
        return [*self._taken(), *map(_line, (*self._counts.over(now), *self._writes.over(now)))]

    def rest(self) -> list[dict[str, object]]:
        """Returns the lines of all refusals, also before the end of the interval."""
        return [*self._taken(), *map(_line, (*self._counts.rest(), *self._writes.rest()))]

    def _taken(self) -> Iterator[dict[str, object]]:
        while self._first:
            yield self._first.popleft()


def _is_audited(event: str, fields: Mapping[str, object]) -> bool:
    if event in REQUESTS:
        function = OF_CODE.get(cast("int", fields.get("function")))
        # The engine gives writes to `has_line`: crates/engine/src/server/reports/audit.rs.
        return function is None or not function.writes
    return event in CONNECTIONS or (event, fields.get("reason")) in DENIALS


def _line(counted: tuple[object, Origin, int]) -> dict[str, object]:
    kind, by, count = counted
    return {**dict(cast("Iterable[tuple[str, object]]", kind)), **by.fields(), "count": count}
