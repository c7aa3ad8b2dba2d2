"""The audit log of a running appliance: opened, filled with writes and refusals, closed."""

from __future__ import annotations

import logging
import threading
from collections import deque
from typing import TYPE_CHECKING, Any, cast

from holdfast._core import __version__
from holdfast.appliance.parts.part import Part
from holdfast.config.values.urls import parse_syslog
from holdfast.events import log_lines
from holdfast.runtime.heartbeat import PERIOD_S, Heartbeat
from holdfast.runtime.standstill import WallClock
from holdfast.runtime.text import file_error_text

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from holdfast._core import Engine
    from holdfast.appliance.parts.part import Plan
    from holdfast.config import Config
    from holdfast.config.models.services import AuditConfig
    from holdfast.events.audit import Audit, Copies
    from holdfast.types import ThreadHeartbeat

# The most writes that are moved to the audit log at once.
MAX_WRITES_PER_BATCH = 1000

# How long the thread waits for a write. The engine wakes it for each write, and when it stops.
TIMEOUT_S = PERIOD_S

# The time between attempts to write a log that fails.
RETRY_S = 1.0


class AuditLog(Part):
    """The audit log, if there is one: opened before anything listens, closed after the last write.

    Steps of the wall clock are logged also without one.
    """

    # A hanging service may wait for a shared log, and writes its record when the log is closed.
    closing_rank = 1

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.log: Audit | None = None
        self._recorder: WriteRecorder | None = None
        self._clock = WallClock()

    def open(self, plan: Plan) -> None:
        """Opens the file, and records the start."""
        settings = plan.config.audit
        if settings is None:
            return
        from holdfast.events.audit import Audit

        try:
            self.log = log = Audit(
                settings.file,
                max_bytes=settings.max_bytes,
                keep=settings.keep,
                fail_closed=settings.fail == "closed",
                copies=_copies(settings),
            )
        except OSError as error:
            raise OSError(f"audit.file: {file_error_text(error)}") from error
        self._record(log, "start")
        self.closing.callback(log.close)
        self.closing.callback(self._record, log, "stop")

    def record_writes_of(self, engine: Engine) -> None:
        """Starts the thread that records writes of clients, and refusals, until all is recorded."""
        if self.log is not None:
            self._recorder = WriteRecorder(self.log, engine)
            self._recorder.start()
            self.closing.callback(self._recorder.finish)

    def prepare(self, plan: Plan) -> Callable[[], None]:  # noqa: ARG002
        """Reopens the file after a rename."""
        return self._reopen

    def tick(self) -> None:
        """Logs and records a step of the wall clock."""
        step = self._clock.look()
        if step is not None and self._recorder is not None:
            self._recorder.note("clock_stepped", step=step)

    def heartbeats(self) -> Sequence[ThreadHeartbeat]:
        """The heartbeat of the thread."""
        return () if self._recorder is None else [self._recorder.heartbeat()]

    def stats(self) -> Mapping[str, Any]:
        """The counters of the log."""
        return {"audit": None if self.log is None else self.log.counts()}

    def _reopen(self) -> None:
        if self.log is not None:
            self.log.reopen()
            self._record(self.log, "reload")

    def _record(self, log: Audit, event: str) -> None:
        """Records an event of the appliance, with the digest of its configuration."""
        log.write(event=event, version=__version__, config_sha256=self.config.sha256)


class WriteRecorder:
    """Moves writes and refusals to the audit log, in a thread, until the engine has stopped."""

    def __init__(self, audit: Audit, engine: Engine) -> None:
        self._audit = audit
        self._engine = engine
        self._refusals = audit.refusals
        self._events: deque[dict[str, object]] = deque()
        self._lost = self._others = 0
        self._stopped = threading.Event()
        self._heartbeat = Heartbeat()
        self._thread = threading.Thread(target=self._run, name="holdfast-audit")
        audit.on_failing(engine.set_audit_failing)

    def start(self) -> None:
        """Starts the thread."""
        log_lines.observe(self._refusals.note)
        self._thread.start()

    def note(self, event: str, **fields: object) -> None:
        """Records an event. Does not wait. Thread-safe."""
        self._events.append({"event": event, **fields})

    def heartbeat(self) -> ThreadHeartbeat:
        """Returns the heartbeat of the thread. Thread-safe."""
        return self._thread.name, self._heartbeat.age, self._thread.native_id

    def finish(self) -> None:
        """Waits until all is moved. Call it after the engine and the services have stopped."""
        log_lines.forget(self._refusals.note)
        self._stopped.set()
        self._engine.stop()  # Ends the wait for a write.
        self._thread.join()

    def _run(self) -> None:
        while True:
            self._heartbeat.beat()
            ended = self._stopped.is_set()
            if self._audit.fail_closed and self._audit.failing and not ended:
                # Writes wait in the queue of the engine, whose room is limited.
                self._stopped.wait(RETRY_S)
                self._audit.retry()
                continue
            writes = self._engine.next_writes(0 if ended else TIMEOUT_S, MAX_WRITES_PER_BATCH)
            lines = [write for write in writes if self._has_line(write)]
            self._count_others()
            more = self._refusals.rest() if ended else self._refusals.take()
            while self._events:
                more.append(self._events.popleft())
            self._audit.write_all([*lines, *more])
            self._log_lost()
            if ended and not writes:
                return

    def _has_line(self, write: dict[str, object]) -> bool:
        times = cast("int", write.pop("refusals", 0))
        return not times or self._refusals.has_line(write, times)

    def _count_others(self) -> None:
        others = self._engine.other_refused_writes
        if others > self._others:
            self._refusals.note_others(others - self._others)
            self._others = others

    def _log_lost(self) -> None:
        missed = self._engine.lost_writes
        if missed > self._lost:
            self._audit.write(lost=missed - self._lost)
            log_lines.write(logging.ERROR, "audit_lost", count=missed - self._lost)
            self._lost = missed


def _copies(settings: AuditConfig) -> list[Copies]:
    from holdfast.events.audit import Copies, Journal, Syslog

    copies = []
    if settings.syslog is not None:
        copies.append(Copies("syslog", Syslog(*parse_syslog(settings.syslog))))
    if settings.journald:
        copies.append(Copies("journald", Journal()))
    return copies
