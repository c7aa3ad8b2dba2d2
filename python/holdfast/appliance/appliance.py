"""The appliance runs one configuration: its list of parts, from start to stop.

It only connects the parts. It parses no protocol, and takes no part in answering requests.
"""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Self

from holdfast import _core
from holdfast.appliance.diagnostics import Diagnostics
from holdfast.appliance.health import SERVICES, Health, probe_url
from holdfast.appliance.liveness import Liveness
from holdfast.appliance.parts.audit import AuditLog
from holdfast.appliance.parts.certificate_expiry import CertificateExpiry
from holdfast.appliance.parts.device_leases import DeviceLeases
from holdfast.appliance.parts.devices import Devices
from holdfast.appliance.parts.listeners import ListenAddress, Listeners
from holdfast.appliance.parts.memories import Memories, created
from holdfast.appliance.parts.mirrors import Mirrors
from holdfast.appliance.parts.part import Part, Plan
from holdfast.appliance.parts.shared_logs import SharedLogs
from holdfast.appliance.reload import (
    ReloadIncomplete,
    ReloadRefused,
    differences,
    fingerprints,
    restart_reasons,
)
from holdfast.appliance.services.adapters import (
    ForeignAdapters,
    MetricsService,
    MqttService,
    RestService,
)
from holdfast.appliance.services.gateway import GatewayService
from holdfast.appliance.services.outputs import Outputs
from holdfast.appliance.services.scanner import ScannerService
from holdfast.appliance.services.services import LastServices, ServiceContext, Services
from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.appliance.services.supervision import Supervisor
    from holdfast.config import Config
    from holdfast.replication.leases.times import LeaseTimes

CHECK_INTERVAL_S = 1.0
"""The time between checks of all parts for what is to be logged."""


class Appliance:
    """Runs one configuration, from `start` (or `with`) to `stop`.

    `start` raises `OSError` if the address of a listener can't be bound or a file can't be opened,
    and `UnknownAdapter` if an adapter is not installed. Nothing is left running then. The ports of
    REST, gateway and metrics are tried again until they can be bound, because these services must
    not keep Modbus from starting. Without `retries_ports`, `start` raises `OSError` for them too.

    `lease_times` are those of devices that several appliances could poll.
    """

    def __init__(
        self,
        config: Config,
        *,
        retries_ports: bool = True,
        lease_times: LeaseTimes | None = None,
    ) -> None:
        self.config = config
        self._lease_times = lease_times
        self._retries_ports = retries_ports
        self.memories = {name: created(config, name) for name in config.memories}
        self._running: _Running | None = None
        self._was_started = False
        self.lost_writes = 0
        """The confirmed writes to memories that the last stop could not store."""

    def start(self) -> Self:
        """Binds the listeners and serves. Raises `RuntimeError` if already running."""
        if self._running is not None:
            raise RuntimeError("the appliance is already running")
        if self._was_started:
            # The contents of memories that are kept come from their files and logs again.
            for name, settings in self.config.memories.items():
                if settings.keep is not None or settings.replicate is not None:
                    self.memories[name] = created(self.config, name)
        self._was_started = True
        running = _Running(self.config, self.memories, self, self._lease_times)
        running.start(retries_ports=self._retries_ports)
        self._running = running
        log_lines.write(
            logging.INFO, "started", version=_core.__version__, sha256=self.config.sha256 or "-"
        )
        running.log_listening()
        return self

    def stop(self) -> None:
        """Answers the requests already received, then stops."""
        running, self._running = self._running, None
        if running is not None:
            running.stop()
            self.lost_writes = running.memories.lost_writes
            log_lines.write(logging.INFO, "stopped")

    def reload(self, config: Config) -> list[str]:
        """Takes over a configuration without touching memory or what it does not concern.

        Returns the keys of what has changed. Raises `ReloadRefused` for changes that require a
        restart, `OSError` for an address that can't be bound or a file that can't be opened, and
        `UnknownAdapter`; nothing has changed then. Raises `ReloadIncomplete` for an internal error
        after the listeners have changed. Call it in the thread that calls `log_events`.
        """
        changed = self._require_running().reload(config)
        self.config = config
        self._require_running().log_listening()
        return changed

    @property
    def is_live(self) -> bool:
        """Whether no thread was stalled when `log_events` looked last. False if not running."""
        return self._running is not None and self._running.health.is_live

    @property
    def health(self) -> Health:
        """Whether it is live and ready. Raises `RuntimeError` if not running."""
        return self._require_running().health

    @property
    def diagnostics(self) -> Diagnostics:
        """The diagnostics. Raises `RuntimeError` if not running."""
        return self._require_running().diagnostics

    def endpoints(self) -> list[ListenAddress]:
        """Returns the addresses of all listeners and services, in configuration order."""
        return self._require_running().endpoints()

    def probe_url(self) -> tuple[str, str] | None:
        """What `holdfast.appliance.health.probe_url` returns for the service that answers probes.

        `None` without one. Thread-safe.
        """
        running = self._require_running()
        endpoints = running.services.endpoints | running.metrics.endpoints
        for name in SERVICES:
            if (found := endpoints.get(name)) is not None:
                return probe_url(name, found.settings, found.port.address[1])
        return None

    def log_events(self, timeout: float) -> None:
        """Waits up to `timeout` seconds for a listener event and logs it.

        Also logs changes of seals and of the health of devices, and threads that are stalled.
        """
        self._require_running().log_events(timeout)

    def sessions(self) -> list[dict[str, Any]]:
        """The open connections of all listeners. Thread-safe."""
        return self._require_running().listeners.engine.sessions()

    def replicas(self) -> dict[str, dict[str, Any]]:
        """The state of each log that memories are replicated through. Thread-safe."""
        return dict(self._require_running().leases.stats()["logs"])

    def end_session(self, listener: str, number: int, by: Mapping[str, str]) -> bool:
        """Ends a connection. Returns whether there was one. Thread-safe.

        `by` is who has requested it, as fields of the audit log.
        """
        return self._require_running().listeners.end_session(listener, number, by)

    def _require_running(self) -> _Running:
        if self._running is None:
            raise RuntimeError("the appliance is not running")
        return self._running

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()


class _Running:
    """The parts of a running appliance. `start` starts all of them or none."""

    def __init__(
        self,
        config: Config,
        memories: dict[str, _core.Memory],
        appliance: Appliance,
        lease_times: LeaseTimes | None,
    ) -> None:
        self._config = config
        self._fingerprints = fingerprints(config)
        self._checked = time.monotonic()
        self._parts: list[Part] = []
        adapters: dict[str, Supervisor] = {}
        self.liveness = Liveness(
            lambda: [each for part in self._parts for each in part.heartbeats()]
        )
        self.memories = Memories(config, memories)
        self.audit = audit = AuditLog(config)
        logs = SharedLogs(config, self.memories)
        self.leases = DeviceLeases(config, logs, lease_times)
        mirrors = Mirrors(config)
        self.devices = Devices(config, audit, self.leases, mirrors)
        self.listeners = Listeners(config, audit)
        self.health = Health(
            self.liveness,
            logs,
            adapters,
            self.devices.health,
            self.leases.unpolled,
            lambda: len(self.listeners.config.listeners),
        )
        self.diagnostics = Diagnostics(
            memories, self.liveness, self._parts, adapters, self.devices.readings
        )
        context = ServiceContext(
            memories, audit, self.devices, self.diagnostics, self.health, appliance, logs, adapters
        )
        self.metrics = LastServices(config, context, MetricsService())
        self.services = Services(
            config,
            context,
            RestService(),
            MqttService(),
            ScannerService(),
            GatewayService(),
            Outputs(),
            ForeignAdapters(),
        )
        # Opened in this order, closed in the opposite one unless a part has a rank.
        self._parts += [
            self.memories,  # Loaded before anything listens.
            logs,  # Joined before anything listens, left after all that write to their memories.
            CertificateExpiry(config),
            mirrors,  # Reserves what devices are read into before anybody writes there.
            audit,  # Has no start that no write can follow. Its rank: after the last write.
            self.devices,  # Polls until listeners and services have answered all requests.
            self.leases,  # Given back while devices are still polled.
            self.services,
            self.metrics,  # Its rank: after all others, so that probes see the stop.
            self.listeners,  # Once it has taken over a reload, no other part may refuse it.
        ]

    def start(self, *, retries_ports: bool) -> None:
        """Opens all parts, then starts them. If one fails, those before are closed again."""
        with ExitStack() as undo:
            memories = dict(self.memories.by_name)
            plan = Plan(self._config, self._fingerprints, memories, undo, retries_ports)
            for part in self._parts:
                undo.callback(part.close)
                part.open(plan)
            for part in self._parts:
                part.start()
            undo.pop_all()  # All have started: nothing is closed.

    def stop(self) -> None:
        """Requests the stop of all parts, then waits for each."""
        self.health.stopping = True
        parts = sorted(self._parts, key=lambda part: -part.closing_rank)
        # Backwards, and each of them, also if one before it fails.
        with ExitStack() as closing:
            for part in parts:
                closing.callback(part.close)
            # Forwards: devices offer no more values before the first output ends.
            for part in self._parts:
                part.stop()

    def reload(self, config: Config) -> list[str]:
        """Takes over a configuration, see `Appliance.reload`."""
        reasons = list(restart_reasons(self._config, config))
        if reasons:
            raise ReloadRefused([f"{reason}; requires a restart" for reason in reasons])
        now = fingerprints(config)
        changed = differences(self._fingerprints, now)
        with ExitStack() as undo:
            plan = Plan(config, changed, dict(self.memories.by_name), undo)
            prepared = [part.prepare(plan) for part in self._parts]
            undo.pop_all()  # All are prepared: what they have opened is kept.
        self._config, self._fingerprints = config, now
        for part in self._parts:
            part.config = config
        try:
            for adopt in prepared:
                adopt()
        except Exception as error:
            raise ReloadIncomplete(f"{type(error).__name__}: {error}") from error
        log_lines.change(config.log.level, config.log.format)
        return changed

    def endpoints(self) -> list[ListenAddress]:
        """Returns where listeners and HTTP services listen."""
        services = (*self.services.endpoints.values(), *self.metrics.endpoints.values())
        return [*self.listeners.addresses(), *(each.address for each in services)]

    def log_listening(self) -> None:
        """Logs the listeners and bound ports that were not logged yet."""
        self.listeners.log_listening()
        for each in (*self.services.endpoints.values(), *self.metrics.endpoints.values()):
            each.port.log_listening()

    def log_events(self, timeout_s: float) -> None:
        """Waits for an event, and logs it. Logs what else has changed about once a second."""
        self.listeners.log_events(timeout_s)
        self.memories.log_seals()
        now = time.monotonic()
        if now - self._checked >= CHECK_INTERVAL_S:
            self._checked = now
            log_lines.tell_held_back()
            self.liveness.check()
            for part in self._parts:
                part.tick()
