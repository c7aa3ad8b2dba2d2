"""Whether an appliance is live and ready. Probes, metrics and the watchdog use this judgement."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.net.addresses import admits, joined, reachable
from holdfast.net.http.health import Check

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from holdfast.appliance.liveness import Liveness
    from holdfast.appliance.parts.shared_logs import SharedLogs
    from holdfast.appliance.services.services import HttpConfig
    from holdfast.appliance.services.supervision import Supervisor

SERVICES = ("metrics", "gateway")
"""The sections of services that answer probes, in the order to try."""

MAX_NAMES = 5
"""The most names in the detail of a check."""


def probe_url(name: str, settings: HttpConfig, port: int) -> tuple[str, str]:
    """Returns the URL at which this machine asks a service, and why it may refuse that."""
    scheme = "http" if settings.tls is None else "https"
    host = reachable(settings.bind.host, settings.sources)
    refused = not admits(settings.sources, host)
    hint = f"; {name}.sources does not contain {host}" if refused else ""
    return f"{scheme}://{joined(host, port)}", hint


@dataclass(eq=False)
class Health:
    """The health of one running appliance. Thread-safe, and never waits for any of its parts."""

    _liveness: Liveness
    _logs: SharedLogs
    _adapters: Mapping[str, Supervisor]
    _devices: Callable[[], Mapping[str, str]]
    """Returns the health of each polled device, as the main thread saw it last."""
    _unpolled: Callable[[], Mapping[str, str]]
    """Returns the devices that no node of their log polls, and why."""
    _listeners: Callable[[], int]
    """Returns how many listeners there are."""
    _polled: set[str] = field(default_factory=set)
    """Devices that were polled. They stay so if a reload changes their settings."""
    stopping: bool = False
    """Whether the appliance has begun to stop. It is live then, but never ready."""

    @property
    def is_live(self) -> bool:
        """Whether every check of `live` has passed."""
        return all(check.ok for check in self.live().values())

    def live(self) -> dict[str, Check]:
        """Returns whether all threads get to their work."""
        return {"threads": self._threads()}

    def ready(self) -> dict[str, Check]:
        """Returns whether clients can be sent to this appliance.

        Devices, brokers and receivers that can't be reached do not count: no restart and no other
        appliance would help, and what is served tells their state. A device that no node polls
        counts: nothing else tells that its values are old.
        """
        return {
            "running": Check(not self.stopping, "stopping" if self.stopping else "running"),
            "threads": self._threads(),
            "listeners": Check(not self.stopping, f"{self._listeners()} bound"),
            "services": self._services(),
            "devices": self._started(),
            "logs": self._caught_up(),
        }

    def _threads(self) -> Check:
        stalled = [] if self.stopping else self._liveness.stalled()
        return Check(not stalled, f"stalled: {_named(stalled)}" if stalled else "all run")

    def _services(self) -> Check:
        """The HTTP services: their ports are bound, and they run."""
        states = {name: each.serves() for name, each in dict(self._adapters).items()}
        with_port = {name: serves for name, serves in states.items() if serves is not None}
        failed = [name for name, serves in with_port.items() if not serves]
        if failed:
            return Check(False, f"not serving: {_named(failed)}")
        return Check(True, f"{len(with_port)} serving" if with_port else "none")

    def _started(self) -> Check:
        """Each device was polled once, or the attempt has failed, or another node polls it."""
        devices = self._devices()
        polled = {name for name, health in devices.items() if health != "unknown"}
        polled |= self._polled & devices.keys()
        self._polled = polled
        if waiting := devices.keys() - polled:
            return Check(False, f"not polled yet: {_named(waiting)}")
        if unpolled := self._unpolled():
            reasons = "; ".join(sorted(set(unpolled.values())))
            return Check(False, f"polled by no node: {_named(unpolled)}: {reasons}")
        if not devices:
            return Check(True, "none")
        standby = sum(health == "standby" for health in devices.values())
        failing = sum(health not in ("ok", "standby") for health in devices.values())
        detail = f"{len(devices) - standby} polled, {failing} without valid replies"
        return Check(True, detail + (f", {standby} on standby" if standby else ""))

    def _caught_up(self) -> Check:
        states = self._logs.status()
        whys = {name: each["obstacle"] for name, each in states.items()}
        behind = [f"{name}: {why}" for name, why in whys.items() if why is not None]
        if behind:
            return Check(False, "; ".join(behind))
        return Check(True, f"{len(states)} caught up" if states else "none")


def _named(names: Iterable[str]) -> str:
    """The first names, and how many more there are."""
    found = sorted(names)
    more = len(found) - MAX_NAMES
    return ", ".join(found[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")
