"""The listeners: the native engine, its events and sessions."""

from __future__ import annotations

import logging
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from holdfast import _core
from holdfast.appliance.parts.native_listeners import identity, listener
from holdfast.appliance.parts.part import Part
from holdfast.config.models.listeners import SerialListener, tls_of
from holdfast.events import log_lines
from holdfast.net.addresses import joined
from holdfast.net.http.port import explained
from holdfast.server.fork import close_in_children

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from holdfast.appliance.parts.audit import AuditLog
    from holdfast.appliance.parts.part import Plan
    from holdfast.config import Config
    from holdfast.config.models.listeners import Listener
    from holdfast.config.models.services import GatewayConfig, MetricsConfig, RestConfig
    from holdfast.types import ThreadHeartbeat

GROUP = "add the user to the group of the device, on Linux mostly dialout"

# Events that are not rate-limited. All others are, as warnings or LIMITED_INFOS.
LEVELS = {
    "opened": logging.DEBUG,
    "closed": logging.DEBUG,
    "idle": logging.DEBUG,
    "line_back": logging.INFO,
    "rights_revoked": logging.INFO,
    "ended": logging.DEBUG,
}

LIMITED_INFOS = ("secured", "unit_back")

# Events whose number is limited for each value of this field, and not for each reason.
LIMITED_BY = {
    "secured": "role",
    "refused_role": "role",
    "unit_silenced": "unit",
    "unit_back": "unit",
}

# The fields of a connection that was ended, in the audit log.
_AUDITED = ("peer", "role", "subject", "serial")


@dataclass(frozen=True)
class ListenAddress:
    """Where a listener or an HTTP service listens: a socket address or a serial device."""

    name: str
    type: str
    host: str
    port: int | None
    """`None` on a serial line, whose device is `host`."""
    settings: Listener | RestConfig | GatewayConfig | MetricsConfig
    error: str | None = None
    """Why the port of an HTTP service is not bound yet."""


class Listeners(Part):
    """All listeners. The last part: what it takes over can't be undone."""

    engine: _core.Engine

    def __init__(self, config: Config, audit: AuditLog) -> None:
        super().__init__(config)
        self._audit = audit
        self._lost_events = 0
        self._logged: dict[str, tuple[str, int | None]] = {}
        """Where listeners have logged that they listen."""
        self._reviewed = time.monotonic()

    def open(self, plan: Plan) -> None:
        """Binds all listeners, and serves."""
        audit = self.config.audit
        with _with_permission_hint(plan.config):
            self.engine = _core.Engine(
                **_settings(plan),
                workers=self.config.workers,
                audit=None if audit is None else audit.fail,
            )
        close_in_children(self.engine)
        self.closing.callback(self._log_last_events)
        # Answers the requests already received.
        self.closing.callback(self.engine.stop)
        self._audit.record_writes_of(self.engine)

    def prepare(self, plan: Plan) -> Callable[[], None]:
        """Takes over all listeners, or refuses all. Every other part is prepared by then."""
        with _with_permission_hint(plan.config):
            self.engine.reload(**_settings(plan))
        return super().prepare(plan)

    def log_events(self, timeout_s: float) -> None:
        """Waits for an event, and logs it."""
        event = self.engine.next_event(timeout_s)
        if event is not None:
            _log_event(*event)
        lost = self.engine.lost_events
        if lost > self._lost_events:
            log_lines.write(logging.WARNING, "events_lost", count=lost - self._lost_events)
            self._lost_events = lost

    def tick(self) -> None:
        """Reviews the certificates of open connections when that is due."""
        found = map(tls_of, self.config.listeners.values())
        interval_s = min((tls.review for tls in found if tls is not None and tls.review), default=0)
        now = time.monotonic()
        if interval_s and now - self._reviewed >= interval_s:
            self._reviewed = now
            self.engine.review()

    def heartbeats(self) -> Sequence[ThreadHeartbeat]:
        """The heartbeats of the threads that serve."""
        return self.engine.heartbeats()

    def stats(self) -> Mapping[str, Any]:
        """The counters of each listener."""
        return {"listeners": self.engine.counters(), "events_lost": self.engine.lost_events}

    def end_session(self, listener: str, number: int, by: Mapping[str, str]) -> bool:
        """Ends a connection. Returns whether there was one. `by` has requested it."""
        place = {"listener": listener, "id": number}
        known = [each for each in self.engine.sessions() if place.items() <= each.items()]
        if not self.engine.end_session(listener, number):
            return False
        session = {"session": f"{listener}/{number}"}
        for each in known:
            session |= {f"session_{key}": each[key] for key in _AUDITED if key in each}
        log_lines.write(logging.INFO, "session_ended", **session, **by)
        if self._audit.log is not None:
            self._audit.log.write(event="session_ended", **session, **by)
        return True

    def addresses(self) -> Iterator[ListenAddress]:
        """Yields where each listener listens."""
        listeners = self.config.listeners.items()
        for (name, settings), address in zip(listeners, self.engine.addresses, strict=True):
            if isinstance(settings, SerialListener):
                yield ListenAddress(name, settings.type, settings.serial.device, None, settings)
            elif address is not None:
                yield ListenAddress(name, settings.type, *address, settings)

    def log_listening(self) -> None:
        """Logs the addresses that were not logged yet."""
        before, self._logged = self._logged, {}
        for at in self.addresses():
            self._logged[at.name] = (at.host, at.port)
            if before.get(at.name) != (at.host, at.port):
                shown = at.host if at.port is None else joined(at.host, at.port)
                log_lines.listening(at.name, shown, at.port)

    def _log_last_events(self) -> None:
        while (event := self.engine.next_event(0)) is not None:
            _log_event(*event)
        log_lines.tell_held_back(all_of_them=True)


@contextmanager
def _with_permission_hint(config: Config) -> Iterator[None]:
    """Adds what a listener needs to a `PermissionError`, whose text begins with its name."""
    try:
        yield
    except PermissionError as error:
        text = error.strerror or ""
        name = text.removeprefix("listener ").partition(":")[0]
        settings = config.listeners.get(name)
        if settings is None:
            raise
        if isinstance(settings, SerialListener):
            text = f"{text} ({GROUP})"
        else:
            text = explained(error, settings.bind.port)
        raise PermissionError(error.errno, text) from error


def _settings(plan: Plan) -> dict[str, Any]:
    """What the engine serves."""
    config, own = plan.config, identity(plan.config.identity)
    events: Literal["all", "refusals"] = "all" if config.log.level == "debug" else "refusals"
    return {
        "listeners": [
            listener(name, config, plan.memories, plan.links) for name in config.listeners
        ],
        "identity": own.objects(),
        "unit_names": own.names(),
        "events": events,
    }


def _log_event(listener: str, event: str, found: Mapping[str, object]) -> None:
    fields: dict[str, object] = {"listener": listener, "peer": "-", **found}
    times = fields.pop("count", 1)
    assert isinstance(times, int)
    if event in LEVELS:
        log_lines.write(LEVELS[event], event, **fields)
    else:
        level = logging.INFO if event in LIMITED_INFOS else logging.WARNING
        about = found.get(LIMITED_BY.get(event, "reason"))
        log_lines.count(level, event, fields, kind=(listener, about), times=times)
