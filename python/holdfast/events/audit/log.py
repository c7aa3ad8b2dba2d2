"""Writes the audit log: to its file, and as copies to syslog and the journal.

The lines of REST, MQTT and adapters are in the file before memory is written. Those of Modbus and
Raw Ingest follow shortly after, because native threads serve these. Lost lines are reported in a
line of their own.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, TypeAlias

from holdfast.events import log_lines
from holdfast.events.audit.chain import BREAK, End, Record, chained, encoded, unchained
from holdfast.events.audit.file import AuditFile
from holdfast.events.audit.refusal_summaries import Refusals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    import msgspec

    from holdfast.events.audit.copies import Copies

    Line: TypeAlias = Mapping[str, object] | msgspec.Raw
    """The fields of a line, also as JSON."""


class Unrecorded(Exception):
    """A write can't be recorded, and must not be carried out."""


class Group:
    """The lines of writes that are about to be carried out."""

    def __init__(self) -> None:
        self.bodies: list[bytes] = []
        self.is_refused = False
        """Set by the first `write_group` for all that share the group."""


class Audit:
    """An audit log. Thread-safe. Raises `OSError` if the file can't be opened.

    With `fail_closed`, a write that can't be recorded must not be carried out: `write_group` and
    `require` raise `Unrecorded`. Without a file, `copies` are the only log.
    """

    def __init__(
        self,
        file: Path | None,
        *,
        max_bytes: int,
        keep: int,
        fail_closed: bool = False,
        copies: Sequence[Copies] = (),
    ) -> None:
        self.fail_closed = fail_closed
        self.refusals = Refusals()
        """The refusals that are counted. Whoever takes them writes their lines."""
        self._file = None if file is None else AuditFile(file, max_bytes=max_bytes, keep=keep)
        self._copies = copies
        self._lock = threading.Lock()
        self._end = End() if self._file is None else self._file.end
        self._written = self._lost = 0
        self._lost_unreported = 0
        """Lost lines that no line of the file reports yet."""
        self._waiting: list[Record] = []
        self._group = Group()
        self._failing = self._is_closed = False
        self._reasons: set[str] = set()
        """Why the file could not be written, since it began to fail."""
        self._on_failing: Callable[[bool], object] = lambda _: None
        for each in copies:
            each.start()

    def write(self, **fields: object) -> None:
        """Writes one line: the time, its place in the chain, then the fields."""
        self.write_all([fields])

    def write_refused(self, **fields: object) -> None:
        """Writes or counts a write that was refused, and that changed nothing."""
        if self.refusals.has_line(fields):
            self.write(**fields)

    def write_all(self, lines: Iterable[Line]) -> None:
        """Writes lines, all with the present time.

        After lines that could not be written, a line with their number comes first. But if the log
        is `fail_closed`, they wait in memory, and are written as soon as that is possible: writes
        that were carried out before it failed, then refusals and events, which are few.
        """
        records = self._records(lines)
        with self._lock:
            stored = self._store(records)
            if stored == len(records):
                return
            if self.fail_closed and not self._is_closed:
                self._waiting += records[stored:]
            else:
                self._lose(records[stored:])

    def queue(self, lines: Iterable[Line]) -> Group:
        """Queues the lines of a write that is about to be carried out, for `write_group`.

        Lines that are queued before that call are written together: a system call costs several
        times as much as encoding a line.
        """
        bodies = [encoded(fields) for fields in lines]
        with self._lock:
            self._group.bodies += bodies
            return self._group

    def write_group(self, group: Group) -> None:
        """Writes the lines of a group, unless that was done already.

        Raises `Unrecorded` if the log is `fail_closed` and can't be written. Then no line is
        stored.
        """
        with self._lock:
            if group is self._group:
                self._group = Group()
                now = log_lines.timestamp(time.time())
                records = [(now, body) for body in group.bodies]
                stored = self._store(records, together=self.fail_closed)
                if stored < len(records):
                    group.is_refused = self.fail_closed
                    if not self.fail_closed:
                        self._lose(records[stored:])
        if group.is_refused:
            raise Unrecorded

    def require(self) -> None:
        """Raises `Unrecorded` if the log is `fail_closed` and could not be written last time."""
        if self.fail_closed and self._failing:
            self.retry()
            if self._failing:
                raise Unrecorded

    def retry(self) -> None:
        """Tries to write waiting lines, and the number of lost lines.

        Does nothing if the log is complete. If it fails and nothing waits, the number tests the
        file, even if it is 0.
        """
        with self._lock:
            if self._waiting or self._lost_unreported or self._failing:
                self._store([])

    def rotate(self) -> None:
        """Puts the file aside as if it were full, and begins a new one. An empty file stays."""
        self._check(puts_aside=True)

    def reopen(self) -> None:
        """Opens a new file if something else has renamed or deleted the present one."""
        self._check(puts_aside=False)

    def _check(self, *, puts_aside: bool) -> None:
        with self._lock:
            if self._file is None or self._is_closed:
                return
            try:
                self._file.check()
                if puts_aside and not self._file.is_empty:
                    self._file.rotate()
            except OSError as error:
                self._note_failure(error)

    @property
    def failing(self) -> bool:
        """Whether the file could not be written last time."""
        return self._failing

    def on_failing(self, callback: Callable[[bool], object]) -> None:
        """Calls `callback` now, and whenever the file begins or ceases to fail."""
        with self._lock:
            self._on_failing = callback
            callback(self._failing)

    def counts(self) -> dict[str, object]:
        """Returns the numbers of lines written, failed and waiting, and those of the copies."""
        with self._lock:
            return {
                "lines": self._written,
                "failed": self._lost,
                "waiting": len(self._waiting),
                "failing": self._failing,
                "copies": {each.name: each.counts() for each in self._copies},
            }

    def close(self) -> None:
        """Writes what waits, and closes file and copies. What the file still lacks is logged. Later
        lines are lost.
        """
        with self._lock:
            if self._waiting or self._lost_unreported:
                self._store([])
            self._lose(self._waiting)
            if self._lost_unreported and not self._is_closed:
                log_lines.write(logging.ERROR, "audit_lost", count=self._lost_unreported)
            self._waiting, self._is_closed = [], True
            if self._file is not None:
                self._file.close()
        for each in self._copies:
            each.close()

    @staticmethod
    def _records(lines: Iterable[Line]) -> list[Record]:
        now = log_lines.timestamp(time.time())
        return [(now, encoded(fields)) for fields in lines]

    def _store(self, records: list[Record], *, together: bool = False) -> int:
        """Stores records after all that wait. Returns how many of them were stored."""
        reports: list[Line] = []
        if self._is_closed:
            return 0
        if self._file is not None:
            try:
                self._file.check()
            except OSError as error:
                self._note_failure(error)
                return 0
            if self._file.broken is not None:
                reports.append({"event": BREAK, **self._file.broken})
        # Without a line to write, nothing shows whether the file can be written again.
        is_probe = self._failing and not records and not self._waiting
        if self._lost_unreported or is_probe:
            reports.append({"lost": self._lost_unreported})
        before = [*(self._records(reports) if reports else ()), *self._waiting]
        written = self._append([*before, *records] if before else records, together=together)
        if written >= len(reports):
            self._lost_unreported = 0
            if self._file is not None:
                self._file.broken = None
            self._waiting = self._waiting[written - len(reports) :]
        self._written += max(0, written - len(reports))
        return max(0, written - len(before))

    def _append(self, records: list[Record], *, together: bool) -> int:
        """Appends records to the file, then sends their copies. Returns how many were stored."""
        lines, digests = chained(self._end, records)
        written = 0
        if self._file is None:
            written = len(lines)
        else:
            try:
                for count in self._file.append(lines, together=together):
                    written += count
            except OSError as error:
                self._note_failure(error)
            else:
                self._set_failing(False)
        if written:
            self._end = End(self._end.seq + written, digests[written - 1])
        self._send(lines[:written])
        return written

    def _send(self, lines: Sequence[bytes]) -> None:
        for each in self._copies:
            each.put(lines)

    def _lose(self, records: Sequence[Record]) -> None:
        """Counts lines that the file lacks. Their copies have no place in the chain."""
        self._lost += len(records)
        self._lost_unreported += len(records)
        self._send([unchained(record) for record in records])

    def _note_failure(self, error: OSError) -> None:
        """Marks the log as failing, and logs each new reason."""
        assert self._file is not None
        if str(error) not in self._reasons:
            self._reasons.add(str(error))
            log_lines.problem("audit_failed", file=str(self._file.file))
        self._set_failing(True)

    def _set_failing(self, failing: bool) -> None:
        if failing != self._failing:
            self._failing = failing
            if not failing:
                self._reasons.clear()
                log_lines.write(logging.INFO, "audit_back", lost=self._lost_unreported)
            self._on_failing(failing)
