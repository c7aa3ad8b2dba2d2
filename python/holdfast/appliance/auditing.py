"""The audit log of a running appliance: opened, filled with the writes of listeners, closed."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

from holdfast import logs
from holdfast._core import __version__
from holdfast.audit import Audit, Copies, Journal, Syslog
from holdfast.config.syslog import parse_syslog
from holdfast.heartbeat import PERIOD, Heartbeat

if TYPE_CHECKING:
    from holdfast._core import Engine
    from holdfast.config import AuditConfig, Config
    from holdfast.types import ThreadHeartbeat

# The most writes that are moved to the audit log at once.
BATCH = 1000

# Seconds that the thread waits for a write. The engine wakes it for each write, and when it stops.
TIMEOUT = PERIOD

# Seconds between attempts to write a log that fails.
RETRY = 1.0


def opened(config: Config) -> Audit | None:
    """Opens the audit log, if there is one, and records the start. Raises `OSError`."""
    if config.audit is None:
        return None
    audit = Audit(
        config.audit.file,
        max_bytes=config.audit.max_bytes,
        keep=config.audit.keep,
        closed=config.audit.fail == "closed",
        copies=_copies(config.audit),
    )
    record(audit, "start", config)
    return audit


def record(audit: Audit, event: str, config: Config) -> None:
    """Records an event of the appliance, with its version and the digest of its configuration."""
    audit.write(event=event, version=__version__, config_sha256=config.sha256)


def closed(audit: Audit, config: Config) -> None:
    """Records the stop and closes the audit log."""
    record(audit, "stop", config)
    audit.close()


class WriteRecorder:
    """Moves the writes of listeners to the audit log, in a thread, until the engine has stopped."""

    def __init__(self, audit: Audit, engine: Engine) -> None:
        self._audit = audit
        self._engine = engine
        self._lost = 0
        self._stopped = threading.Event()
        self._heartbeat = Heartbeat()
        self._thread = threading.Thread(target=self._run, name="holdfast-audit")
        audit.on_failing(engine.set_audit_failing)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def heartbeat(self) -> ThreadHeartbeat:
        """Returns the heartbeat of the thread. Thread-safe."""
        return self._thread.name, self._heartbeat.age, self._thread.native_id

    def finish(self) -> None:
        """Waits until all writes are moved. Call it after the engine has stopped."""
        self._stopped.set()
        self._engine.stop()  # Ends the wait for a write.
        self._thread.join()

    def _run(self) -> None:
        while True:
            self._heartbeat.beat()
            ended = self._stopped.is_set()
            if self._audit.closed and self._audit.failing and not ended:
                # Writes wait in the queue of the engine, whose room is limited.
                self._stopped.wait(RETRY)
                self._audit.retry()
                continue
            writes = self._engine.next_writes(0 if ended else TIMEOUT, BATCH)
            self._audit.write_all(writes, done=True)
            self._tell_lost()
            if ended and not writes:
                return

    def _tell_lost(self) -> None:
        missed = self._engine.lost_writes
        if missed > self._lost:
            self._audit.write(lost=missed - self._lost)
            logs.write(logging.ERROR, "audit_lost", count=missed - self._lost)
            self._lost = missed


def _copies(settings: AuditConfig) -> list[Copies]:
    copies = []
    if settings.syslog is not None:
        transport, target = parse_syslog(settings.syslog.url)
        receiver = Syslog(transport, target, settings.syslog.facility)
        copies.append(Copies("syslog", receiver))
    if settings.journald:
        copies.append(Copies("journald", Journal()))
    return copies
