"""The audit log of a running appliance: opened, filled with writes and refusals, closed."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, cast

from holdfast import logs
from holdfast._core import __version__
from holdfast.audit import Audit, Copies, Journal, Syslog
from holdfast.config.syslog import parse_syslog
from holdfast.protocol import OF_CODE
from holdfast.runtime.heartbeat import PERIOD, Heartbeat

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from holdfast._core import Engine
    from holdfast.config import AuditConfig, Config
    from holdfast.types import ThreadHeartbeat

# The most writes that are moved to the audit log at once.
BATCH = 1000

# Seconds that the thread waits for a write. The engine wakes it for each write, and when it stops.
TIMEOUT = PERIOD

# Seconds between attempts to write a log that fails.
RETRY = 1.0

# Seconds in which refusals of one kind and origin have one line, after that of the first.
INTERVAL = 600.0

# The kinds and origins of refusals that are distinguished in an interval.
MAX_ORIGINS = 250

# The fields that the refusals of a kind have in common.
KIND = ("listener", "adapter", "reason", "role")

# Refused connections and failed handshakes.
CONNECTIONS = ("refused_source", "refused_full", "refused_role", "tls_failed")

# Refused requests of listeners. They are reported once for each connection.
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


class Refusals:
    """The refusals for the audit log, with one line for all of a kind and origin in an interval.

    The first refusal is a line at once, the others are one line at the end of the interval. So
    whoever is refused can't fill a disk, or push other lines out of the file. Thread-safe.
    `note` does not wait.
    """

    def __init__(self, interval: float = INTERVAL) -> None:
        self._counts = logs.Throttle(burst=0, window=interval, most=MAX_ORIGINS)
        self._first: deque[dict[str, object]] = deque()

    def note(
        self, event: str, fields: Mapping[str, object], by: logs.Origin, times: int = 1
    ) -> None:
        """Counts a refusal, if it is one that the audit log has. See `logs.observe`."""
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
        return function is None or not function.writes  # A write has a line of its own.
    return event in CONNECTIONS or (event, fields.get("reason")) in DENIALS


def _line(counted: tuple[object, logs.Origin, int]) -> dict[str, object]:
    kind, by, count = counted
    return {**dict(cast("Iterable[tuple[str, object]]", kind)), **by.fields(), "count": count}


class WriteRecorder:
    """Moves writes and refusals to the audit log, in a thread, until the engine has stopped."""

    def __init__(self, audit: Audit, engine: Engine, interval: float = INTERVAL) -> None:
        """`interval` is that of `Refusals`."""
        self._audit = audit
        self._engine = engine
        self._refusals = Refusals(interval)
        self._events: deque[dict[str, object]] = deque()
        self._lost = 0
        self._stopped = threading.Event()
        self._heartbeat = Heartbeat()
        self._thread = threading.Thread(target=self._run, name="holdfast-audit")
        audit.on_failing(engine.set_audit_failing)

    def start(self) -> None:
        """Starts the thread."""
        logs.observe(self._refusals.note)
        self._thread.start()

    def note(self, event: str, **fields: object) -> None:
        """Records an event. Does not wait. Thread-safe."""
        self._events.append({"event": event, **fields})

    def heartbeat(self) -> ThreadHeartbeat:
        """Returns the heartbeat of the thread. Thread-safe."""
        return self._thread.name, self._heartbeat.age, self._thread.native_id

    def finish(self) -> None:
        """Waits until all is moved. Call it after the engine and the services have stopped."""
        logs.forget(self._refusals.note)
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
            more = self._refusals.rest() if ended else self._refusals.take()
            while self._events:
                more.append(self._events.popleft())
            self._audit.write_all([*writes, *more], done=True)
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
