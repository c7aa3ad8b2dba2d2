"""The logs that appliances share: joined before anything listens, left last."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from holdfast import _core
from holdfast.appliance.client_credentials import tls_files
from holdfast.appliance.parts.part import Part
from holdfast.events import log_lines

if TYPE_CHECKING:
    from holdfast.appliance.parts.memories import Memories
    from holdfast.appliance.parts.part import Plan
    from holdfast.config import Config
    from holdfast.config.models.logs import SharedLogConfig
    from holdfast.net.nats_server import NatsServer
    from holdfast.types import LogStatus

JOIN_TIMEOUT_S = 30.0
"""Seconds in which a node must catch up with its log.

At most `MAX_CUT_OFF` of `lost_messages.rs`: the start must time out, and be retried, before servers
that lag behind this node count as having lost messages. The time for which it asks other nodes
about seals does not count: it has applied all that the servers have then.
"""

PERMANENT = ("layout", "version", "name_taken", "too_many_nodes", "replaced")
"""The kinds of errors that another start meets again. Not `snapshot`: while a node runs, it stores
another one."""

EVENTS = {
    "log_connected": logging.INFO,
    "log_caught_up": logging.INFO,
    "log_disconnected": logging.WARNING,
    "log_connect_failed": logging.WARNING,
    "log_error": logging.WARNING,
    "log_failed": logging.ERROR,
    "log_contents_dropped": logging.ERROR,
    "log_contents_restored": logging.WARNING,
    "log_digests_differ": logging.ERROR,
    "log_message_ignored": logging.WARNING,
    "log_replay_failed": logging.ERROR,
    "log_replicas_differ": logging.WARNING,
    "log_snapshot_stored": logging.DEBUG,
    "log_snapshot_failed": logging.WARNING,
    "log_snapshot_damaged": logging.WARNING,
}
"""The levels of native log events."""


class LogNotJoined(OSError):
    """A log can't be used. With `is_permanent`, a restart does not help."""

    def __init__(self, message: str, *, is_permanent: bool) -> None:
        super().__init__(message)
        self.is_permanent = is_permanent


class SharedLogs(Part):
    """The logs of one configuration."""

    def __init__(self, config: Config, memories: Memories) -> None:
        super().__init__(config)
        self._memories = memories
        self._logs: dict[str, _core.Log] = {}
        self._servers: dict[str, NatsServer] = {}
        self.restored: set[str] = set()
        """The memories whose contents other nodes may have written before this process began."""

    def open(self, plan: Plan) -> None:
        """Returns when the memories have caught up.

        Raises `LogNotJoined`, and the `OSError`s of `MemoryFile`.
        """
        for name, settings in self.config.logs.items():
            members = [
                (each, plan.memories[each])
                for each, memory in self.config.memories.items()
                if memory.replicate is not None and memory.replicate.log == name
            ]
            if members:
                self._serve(name, settings)
                self._join(name, settings, members)

    def _serve(self, name: str, settings: SharedLogConfig) -> None:
        """Starts the server of the log, if the log has one of its own."""
        from holdfast.appliance.parts import log_servers  # Most appliances have no log.
        from holdfast.net.nats_server import TemporarilyUnusable

        server = log_servers.embedded(name, settings)
        if server is None:
            return
        self._servers[name] = server
        self.closing.callback(server.stop)
        try:
            server.start()
        except OSError as error:
            is_permanent = not isinstance(error, TemporarilyUnusable)
            text = f"logs.{name}.embedded: {error}"
            raise LogNotJoined(text, is_permanent=is_permanent) from None

    def _join(
        self, name: str, settings: SharedLogConfig, members: list[tuple[str, _core.Memory]]
    ) -> None:
        from holdfast.appliance.parts import log_servers

        path, note = self._memories.of_log(name), self._memories.note(name)
        try:
            log = _core.Log(
                name,
                settings.node,
                servers(settings),
                members,
                replicas=settings.replicas,
                write_timeout=settings.write_timeout,
                when_behind=settings.when_behind,
                max_lag=settings.max_lag,
                kept_file=None if path is None else str(path),
                **credentials(settings),
            )
            self._logs[name] = log
            # Waits for the writes that were sent.
            self.closing.callback(log.stop)
            if note is not None:
                log.resume(note)
            log_lines.write(logging.INFO, "log_joining", log=name, node=settings.node)
            log.start(JOIN_TIMEOUT_S)
        except _core.LogError as error:
            is_permanent = error.kind in PERMANENT
            raise LogNotJoined(f"logs.{name}: {error}", is_permanent=is_permanent) from None
        except ValueError as error:
            raise LogNotJoined(f"logs.{name}: {error}", is_permanent=True) from None
        sequence, names = log.status()["sequence"], [each for each, _ in members]
        # The first message is that this node has joined. Nobody else writes an embedded log.
        if sequence > 1 and settings.embedded is None:
            self.restored.update(names)
        log_lines.write(
            logging.INFO,
            "log_joined",
            log=name,
            node=settings.node,
            sequence=sequence,
            memories=",".join(names),
        )
        self._memories.follow(name, log)
        log_servers.begin(name, settings)

    def obstacle(self, name: str) -> str | None:
        """Why a log is not caught up; `None` if it is. Thread-safe."""
        return _obstacle(self._logs[name].status(), self.config.logs[name].max_lag)

    def status(self) -> dict[str, dict[str, Any]]:
        """The state and the counters of each log, and why it is not caught up."""
        return {name: self._status(name, log.status()) for name, log in self._logs.items()}

    def _status(self, name: str, status: LogStatus) -> dict[str, Any]:
        settings = self.config.logs[name]
        return {
            **status,
            "node": settings.node,
            "obstacle": _obstacle(status, settings.max_lag),
            "embedded": self._servers[name].status() if name in self._servers else None,
        }

    def tick(self) -> None:
        """Logs what has happened since the last call."""
        for name, log in self._logs.items():
            for event, fields in log.events(0):
                # Limited: any publisher can cause these events.
                log_lines.count(EVENTS[event], event, {"log": name, **fields}, kind=name)


def _obstacle(status: LogStatus, max_lag: float) -> str | None:
    """Why a log is not caught up. Messages that wait do not count: the age of the contents does."""
    if status["failure"] is not None:
        return f"failed ({status['failure'][0]})"
    if status["phase"] != "running":
        return status["phase"]
    if not status["connected"]:
        return "not connected"
    age = status["contact_age"]
    if age is None or age > max_lag:
        since = "no contact yet" if age is None else f"last contact {age:.1f} s ago"
        return f"{since}, allowed {max_lag:g} s"
    return None


def servers(settings: SharedLogConfig) -> list[str]:
    """The URLs of the NATS servers."""
    return [str(url) for url in settings.servers]


def credentials(settings: SharedLogConfig) -> dict[str, Any]:
    """The credentials for the NATS servers, as arguments of `Log` and `LogReader`."""
    files = tls_files(settings.tls)
    return {
        "user": settings.username,
        "password_file": settings.password_file,
        "token_file": settings.token_file,
        "credentials_file": settings.credentials_file,
        "tls": None if settings.tls is None else (files.ca, files.cert, files.key),
    }
