"""The appliance starts, logs and stops the memories, listeners, devices and adapters.

It only connects these parts. It parses no protocol, and takes no part in answering requests.
"""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Self

from holdfast import _core, logs
from holdfast.adapters import foreign
from holdfast.appliance import assembly, auditing, changes, configured_certificates, kept, receivers
from holdfast.appliance.device_leases import DeviceLeases
from holdfast.appliance.diagnostics import Diagnostics, configured
from holdfast.appliance.expiring import Expiring
from holdfast.appliance.health import Health
from holdfast.appliance.kept import KeptMemories
from holdfast.appliance.liveness import Liveness
from holdfast.appliance.mirrors import Mirrors
from holdfast.appliance.output_site import OutputSite
from holdfast.appliance.shared_logs import SharedLogs
from holdfast.appliance.supervision import STOP_TIMEOUT, Starter, Supervisor
from holdfast.appliance.tag_values import TagValues
from holdfast.appliance.tag_writes import TagWrites
from holdfast.client.endpoint import check_files
from holdfast.config import (
    HTTP_SERVICES,
    ModbusAsciiListener,
    ModbusRtuListener,
)
from holdfast.config.fingerprint import fingerprint
from holdfast.config.listeners import tls_of
from holdfast.config.route_checks import routed
from holdfast.faults import fault_word
from holdfast.ingest import MemoryAccess
from holdfast.net.addresses import joined
from holdfast.runtime.standstill import WallClock
from holdfast.server.fork import close_in_children
from holdfast.web.port import Port

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from holdfast.adapters import Adapter
    from holdfast.client.url import Tls
    from holdfast.config import (
        Config,
        GatewayConfig,
        Listener,
        MetricsConfig,
        RestConfig,
    )
    from holdfast.config.outputs import Output
    from holdfast.leases import LeaseTimes
    from holdfast.types import ThreadHeartbeat
    from holdfast.web.https import Https

# All other events of a listener are limited in number, and warnings except `secured`.
LEVELS = {
    "opened": logging.DEBUG,
    "closed": logging.DEBUG,
    "idle": logging.DEBUG,
    "line_back": logging.INFO,
    "rights_revoked": logging.INFO,
    "ended": logging.DEBUG,
}

# Events whose number is limited for each role.
BY_ROLE = ("secured", "refused_role")

# What the audit log has of a connection that was ended.
_SHOWN = ("peer", "role", "subject", "serial")

OUTPUT = "output/"
"""The beginning of the names of outputs among the adapters, whose names have no slash."""

# Seconds without unrequested data after which more of it is logged again.
QUIET = 600.0

# Seconds between checks of the health of devices.
HEALTH_CHECK_INTERVAL = 1.0


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
        self.memories = {name: kept.made(config, name) for name in config.memories}
        self._running: _Running | None = None
        self._was_started = False

    def start(self) -> Self:
        """Binds the listeners and serves. Raises `RuntimeError` if already running."""
        if self._running is not None:
            raise RuntimeError("the appliance is already running")
        if self._was_started:
            # The contents of memories that are kept come from their files and logs again.
            for name, settings in self.config.memories.items():
                if settings.keep is not None or settings.replicate is not None:
                    self.memories[name] = kept.made(self.config, name)
        self._was_started = True
        self._running = _Running(
            self.config,
            self.memories,
            retries_ports=self._retries_ports,
            lease_times=self._lease_times,
        )
        logs.write(
            logging.INFO, "started", version=_core.__version__, sha256=self.config.sha256 or "-"
        )
        self._running.log_listening()
        return self

    def stop(self) -> None:
        """Answers the requests already received, then stops."""
        running, self._running = self._running, None
        if running is not None:
            running.stop()
            logs.write(logging.INFO, "stopped")

    def reload(self, config: Config) -> list[str]:
        """Takes over a configuration without touching memory or what it does not concern.

        Returns the keys of what has changed. Raises `ReloadRefused` for changes that require a
        restart, `OSError` for an address that can't be bound or a file that can't be opened, and
        `UnknownAdapter`; nothing has changed then. Raises `ReloadIncomplete` for an internal error
        after the listeners have changed. Call it in the thread that calls `log_events`.
        """
        changed = self._parts().reload(config)
        self.config = config
        self._parts().log_listening()
        return changed

    @property
    def is_live(self) -> bool:
        """Whether no thread was stalled when `log_events` looked last. False if not running."""
        return self._running is not None and self._running.health.is_live

    @property
    def health(self) -> Health:
        """Whether it is live and ready. Raises `RuntimeError` if not running."""
        return self._parts().health

    @property
    def diagnostics(self) -> Diagnostics:
        """The diagnostics. Raises `RuntimeError` if not running."""
        return self._parts().diagnostics

    def endpoints(self) -> list[ListenAddress]:
        """Returns the addresses of all listeners and services, in configuration order."""
        return self._parts().endpoints()

    def log_events(self, timeout: float) -> None:
        """Waits up to `timeout` seconds for a listener event and logs it.

        Also logs changes of seals and of the health of devices, and threads that are stalled.
        """
        self._parts().log_events(timeout)

    def sessions(self) -> list[dict[str, Any]]:
        """The open connections of all listeners. Thread-safe."""
        return self._parts().sessions()

    def replicas(self) -> dict[str, dict[str, Any]]:
        """The state of each log that memories are replicated through. Thread-safe."""
        return self._parts().diagnostics.shared_logs()

    def end_session(self, listener: str, number: int, by: Mapping[str, str]) -> bool:
        """Ends a connection. Returns whether there was one. Thread-safe.

        `by` is who has requested it, as fields of the audit log.
        """
        return self._parts().end_session(listener, number, by)

    def _parts(self) -> _Running:
        if self._running is None:
            raise RuntimeError("the appliance is not running")
        return self._running

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()


@dataclass(frozen=True)
class _Part:
    """An adapter, as a configuration describes it."""

    fingerprint: str
    factory: Callable[[], Adapter]
    access: MemoryAccess | None = None
    may_end: bool = False
    port: Port | None = None
    starter: Starter | None = None


class _Running:
    """The parts of a running appliance. The constructor starts all of them or none."""

    def __init__(
        self,
        config: Config,
        memories: dict[str, _core.Memory],
        *,
        retries_ports: bool,
        lease_times: LeaseTimes | None,
    ) -> None:
        self._config = config
        self._fingerprints = changes.fingerprints(config)
        self._memories = memories
        self._supervisors: dict[str, Supervisor] = {}
        self._fingerprint_of: dict[str, str] = {}
        """The fingerprints that adapters were started with."""
        self._accesses: dict[str, MemoryAccess] = {}
        self._passages: dict[str, _core.Passage] = {}
        self._lost_events = 0
        self._seals = {name: memory.seal_changes for name, memory in memories.items()}
        self._health = dict.fromkeys(config.devices, "unknown")
        self._plan_errors: dict[str, str | None] = {}
        self._unstored: dict[str, int] = {}
        self._strays: dict[tuple[str, str, str], tuple[int, float]] = {}
        self._forwarded: dict[tuple[str, int], Mapping[str, Any]] = {}
        self._unreachable: set[tuple[str, int]] = set()
        self._expiring = Expiring()
        self._clock = WallClock()
        self._listening: dict[str, tuple[str, int | None]] = {}
        """Where listeners have logged that they listen."""
        self._looked = self._reviewed = time.monotonic()
        self._recorder: auditing.WriteRecorder | None = None
        # Missing adapters and unusable TLS files are reported before any socket is opened.
        _check_parts(config)
        self._https = _loaded_https(config)
        with ExitStack() as undo:
            self._kept = KeptMemories(config, memories)
            undo.callback(self._kept.stop)
            self._logs = SharedLogs(config, memories, self._kept)
            undo.callback(self._logs.stop)
            self._leases = DeviceLeases(config, lease_times)
            self._mirrors = Mirrors(config, memories)
            disabled = self._tell_disabled()
            self._audit = auditing.opened(config)
            if self._audit is not None:
                undo.callback(auditing.closed, self._audit, config)
            self._ports = self._bound_ports(undo, retried=retries_ports)
            # The links of listeners come first: the first use of an address decides its settings.
            self._poller: _core.Poller | None = None
            self._values: TagValues | None = None
            self._writes: TagWrites | None = None
            links, devices = assembly.Links(), list[_core.PolledDevice]()
            if _requires_poller(config):
                self._poller = _core.Poller([])
                undo.callback(self._poller.stop)
                self._values = _tag_values(None, self._poller, config)
                links = assembly.links(config, memories, self._poller)
                devices = [
                    self._device(name, config, memories, self._values)
                    for name, device in config.devices.items()
                    if device.is_polled
                ]
            self._engine = self._started_engine(links)
            self._passages.update(links.passages)
            undo.callback(self._engine.stop)
            if self._poller is not None:
                for device in devices:
                    self._poller.add(device)
            self.liveness = Liveness(self._heartbeats)
            self.health = Health(
                self.liveness,
                self._logs,
                self._supervisors,
                self._polled_health,
                lambda: len(self._config.listeners),
            )
            self.diagnostics = Diagnostics(memories, self._engine, self.liveness)
            self.diagnostics.kept = self._kept
            self.diagnostics.logs = self._logs
            self.diagnostics.leases = self._leases
            self.diagnostics.audit = self._audit
            self.diagnostics.poller = self._poller
            self.diagnostics.links = links.links
            self.diagnostics.disabled = disabled
            self.diagnostics.mirrors = self._mirrors
            self.diagnostics.expiries = configured_certificates.expiries(config)
            self.diagnostics.values = self._values
            for name, part in self._adapters(config, self._ports).items():
                self._add(name, part)
            undo.pop_all()
        if self._values is not None:
            self._values.adopt(config)
            self._values.start()
        if self._audit is not None:
            self._recorder = auditing.WriteRecorder(self._audit, self._engine)
            self._recorder.start()
        for supervisor in self._supervisors.values():
            supervisor.start()
        self._leases.start()

    def stop(self) -> None:
        """Requests the stop of all parts, then waits for each.

        Links stop after all that use them: listeners and the gateway still answer the requests that
        they have passed on. Metrics stop last, so that probes see the stop.
        """
        self.health.stopping = True
        metrics = self._supervisors.get("metrics")
        others = [each for each in self._supervisors.values() if each is not metrics]
        for supervisor in others:
            supervisor.stop()
        self._engine.stop()
        self._log_last_events()
        for supervisor in others:
            supervisor.join()
        self._leases.stop()
        if self._poller is not None:
            self._poller.stop()
        if self._values is not None:
            self._values.join(STOP_TIMEOUT)
        if self._writes is not None:
            self._writes.join(STOP_TIMEOUT)
        for name, port in self._ports.items():
            if name != "metrics":
                port.close()
        self._logs.stop()
        self._kept.stop()
        if self._recorder is not None:
            self._recorder.finish()
        if self._audit is not None:
            auditing.closed(self._audit, self._config)
        if metrics is not None:
            metrics.stop()
            metrics.join()
            self._ports["metrics"].close()

    def _log_last_events(self) -> None:
        while (event := self._engine.next_event(0)) is not None:
            self._log_event(*event)
        logs.tell_held_back(all_of_them=True)

    def log_events(self, timeout: float) -> None:
        event = self._engine.next_event(timeout)
        if event is not None:
            self._log_event(*event)
        lost = self._engine.lost_events
        if lost > self._lost_events:
            logs.write(logging.WARNING, "events_lost", count=lost - self._lost_events)
            self._lost_events = lost
        for name, memory in self._memories.items():
            before, changes_now = self._seals[name], memory.seal_changes
            if changes_now != before:
                self._seals[name] = changes_now
                opened, closed = (now - past for now, past in zip(changes_now, before, strict=True))
                state = "sealed" if memory.sealed else "open"
                logs.write(
                    logging.INFO, "seal", memory=name, state=state, opened=opened, closed=closed
                )
        now = time.monotonic()
        if now - self._looked < HEALTH_CHECK_INTERVAL:
            return
        self._looked = now
        logs.tell_held_back()
        step = self._clock.look()
        if step is not None and self._recorder is not None:
            self._recorder.note("clock_stepped", step=step)
        self.liveness.check()
        self._kept.check()
        self._logs.check()
        self._expiring.check(self.diagnostics.expiries)
        self._mirrors.log_changes()
        interval = _review_interval(self._config)
        if interval is not None and now - self._reviewed >= interval:
            self._reviewed = now
            self._engine.review()
        if self._poller is not None:
            for name, told in configured(self._poller).items():
                self._log_device(name, told)
                self._log_strays("device", name, told)
            for name, link in self.diagnostics.links.items():
                if name not in self._health:
                    self._log_strays("link", name, link.counters())

    def _heartbeats(self) -> list[ThreadHeartbeat]:
        """The heartbeats of all threads that the appliance depends on. Thread-safe."""
        heartbeats = [*self._engine.heartbeats(), *self._leases.heartbeats()]
        if self._poller is not None:
            heartbeats.append(self._poller.heartbeat)
        if self._values is not None and (tags := self._values.heartbeat()) is not None:
            heartbeats.append(tags)
        if self._recorder is not None:
            heartbeats.append(self._recorder.heartbeat())
        own = [supervisor.heartbeat() for supervisor in list(self._supervisors.values())]
        return [*heartbeats, *(each for each in own if each is not None)]

    def _polled_health(self) -> dict[str, str]:
        """The health of each polled device when `log_events` looked last. Thread-safe."""
        health, devices = dict(self._health), self._config.devices
        return {
            name: health[name] for name in health if name in devices and devices[name].is_polled
        }

    def _log_device(self, name: str, told: Mapping[str, Any]) -> None:
        """Logs changes of a device since the last check."""
        health, plan_error, unstored = told["health"], told["plan_error"], told["unstored"]
        if plan_error is not None and plan_error != self._plan_errors.get(name):
            logs.write(logging.ERROR, "device_unplanned", device=name, error=plan_error)
        self._plan_errors[name] = plan_error
        refused = unstored - self._unstored.get(name, 0)
        if refused:
            logs.write(logging.ERROR, "device_unstored", device=name, count=refused)
        self._unstored[name] = unstored
        self._log_forwards(name, told.get("forward", ()))
        if health == self._health[name]:
            return
        self._health[name] = health
        fields: dict[str, object] = {"device": name, "health": health}
        if health == "error":
            fields |= {"error": fault_word(told["last_error"]), "failures": told["failures"]}
        usual = health in ("ok", "standby")
        logs.write(logging.INFO if usual else logging.WARNING, "device_health", **fields)

    def _log_strays(self, kind: str, name: str, told: Mapping[str, int]) -> None:
        """Logs that a device has begun to send what nobody asked for, or all its replies late."""
        if self._has_begun((kind, name, "stray_bytes"), told):
            counted = {"replies": told["unexpected_replies"], "bytes": told["stray_bytes"]}
            logs.write(logging.WARNING, "unrequested_data", **{kind: name}, **counted)
        if self._has_begun((kind, name, "raised_timeouts"), told):
            late = told["late_replies"]
            logs.write(logging.WARNING, "timeout_raised", **{kind: name}, late_replies=late)

    def _has_begun(self, key: tuple[str, str, str], told: Mapping[str, int]) -> bool:
        """Whether a counter has begun to count, or goes on after a while."""
        now, count = time.monotonic(), told[key[-1]]
        before, since = self._strays.get(key, (0, -QUIET))
        if count != before:
            self._strays[key] = (count, now)
        return count > before and now - since >= QUIET

    def _log_forwards(self, name: str, counted: Sequence[Mapping[str, Any]]) -> None:
        """Logs what happened at the receivers of a device since the last check."""
        forwards = self._config.devices[name].forward
        for index, (forward, now) in enumerate(zip(forwards, counted, strict=True)):
            key = (name, index)
            before = self._forwarded.get(key, {})
            self._forwarded[key] = now
            refused = now["refused"] - before.get("refused", 0)
            replied = refused + now["sent"] - before.get("sent", 0)
            failed = now["failed"] - before.get("failed", 0)
            fields: dict[str, object] = {"device": name, "receiver": str(forward.receiver)}
            if refused:
                logs.refused("forward_refused", kind=key, **fields, count=refused)
            if replied and key in self._unreachable:
                self._unreachable.discard(key)
                logs.write(logging.INFO, "forward_back", **fields)
            elif failed and not replied and key not in self._unreachable:
                self._unreachable.add(key)
                told = {key: now[key] for key in ("reason", "error") if now[key] is not None}
                logs.write(logging.WARNING, "forward_failed", **fields, **told)

    def _log_event(self, listener: str, event: str, found: Mapping[str, object]) -> None:
        fields: dict[str, object] = {"listener": listener, "peer": "-", **found}
        times = fields.pop("count", 1)
        assert isinstance(times, int)
        if event in LEVELS:
            logs.write(LEVELS[event], event, **fields)
        else:
            level = logging.INFO if event == "secured" else logging.WARNING
            about = found.get("role" if event in BY_ROLE else "reason")
            logs.count(level, event, fields, kind=(listener, about), times=times)

    def _bound_ports(self, undo: ExitStack, *, retried: bool) -> dict[str, Port]:
        """Tries to bind the ports of the HTTP services. The others are tried again later.

        Raises `OSError` if they are not to be `retried`.
        """
        ports: dict[str, Port] = {}
        for name, settings in _http_services(self._config).items():
            ports[name] = Port(name, settings.bind.host, settings.bind.port)
            undo.callback(ports[name].close)
            if retried:
                ports[name].bind()
            else:
                ports[name].open()
        return ports

    def _started_engine(self, links: assembly.Links) -> _core.Engine:
        config = self._config
        identity = assembly.identity(config.identity)
        engine = _core.Engine(
            [assembly.listener(name, config, self._memories, links) for name in config.listeners],
            identity=identity.objects(),
            unit_names=identity.names(),
            workers=config.workers,
            events=_events(config),
            audit=None if config.audit is None else config.audit.fail,
        )
        close_in_children(engine)
        return engine

    def sessions(self) -> list[dict[str, Any]]:
        return self._engine.sessions()

    def end_session(self, listener: str, number: int, by: Mapping[str, str]) -> bool:
        place = {"listener": listener, "id": number}
        known = [each for each in self.sessions() if place.items() <= each.items()]
        if not self._engine.end_session(listener, number):
            return False
        session = {"session": f"{listener}/{number}"}
        session |= {f"session_{key}": each[key] for each in known for key in _SHOWN if key in each}
        logs.write(logging.INFO, "session_ended", **session, **by)
        if self._audit is not None:
            self._audit.write(event="session_ended", **session, **by)
        return True

    def reload(self, config: Config) -> list[str]:
        """Takes over a configuration, see `Appliance.reload`."""
        reasons = changes.restarts(self._config, config)
        if reasons:
            raise changes.ReloadRefused(reasons)
        _check_parts(config)
        fingerprints = changes.fingerprints(config)
        changed = changes.differences(self._fingerprints, fingerprints)
        https = _loaded_https(config)
        known = self._memories
        added = {name: kept.made(config, name) for name in config.memories if name not in known}
        memories = {**known, **added}
        with ExitStack() as undo:
            ports = self._taken_over_ports(config, undo)
            poller, links = self._poller, assembly.Links()
            if poller is None and _requires_poller(config):
                poller = _core.Poller([])
                undo.callback(poller.stop)
            tag_values = _tag_values(self._values, poller, config)
            if poller is not None:
                links = assembly.links(config, memories, poller)
            devices = {
                name: self._device(name, config, memories, tag_values)
                for name, device in config.devices.items()
                if device.is_polled and f"devices.{name}" in changed
            }
            identity = assembly.identity(config.identity)
            self._engine.reload(
                [assembly.listener(name, config, memories, links) for name in config.listeners],
                identity=identity.objects(),
                unit_names=identity.names(),
                events=_events(config),
            )
            undo.pop_all()
        before, self._config, self._fingerprints = self._config, config, fingerprints
        self._poller = self.diagnostics.poller = poller
        is_new = tag_values is not self._values
        self._values = self.diagnostics.values = tag_values
        known.update(added)
        try:
            if self._values is not None:
                self._values.adopt(config)
                if is_new:
                    self._values.start()
            self._take_over(before, added, links, devices, https, ports)
        except Exception as error:
            raise changes.ReloadIncomplete(f"{type(error).__name__}: {error}") from error
        return changed

    def _take_over(
        self,
        before: Config,
        added: Mapping[str, _core.Memory],
        links: assembly.Links,
        devices: Mapping[str, _core.PolledDevice],
        https: Mapping[str, Https | None],
        ports: dict[str, Port],
    ) -> None:
        """The part of a reload that follows the change of the listeners, and refuses nothing."""
        config = self._config
        self._seals |= {name: memory.seal_changes for name, memory in added.items()}
        self._mirrors.adopt(config, self._memories)
        self._passages.update(links.passages)
        for name in [name for name in self._passages if name not in links.passages]:
            del self._passages[name]
        self.diagnostics.links = links.links
        self._replace_devices(before, devices)
        self._leases.adopt(config)
        self.diagnostics.disabled = self._tell_disabled()
        self.diagnostics.expiries = configured_certificates.expiries(config)
        for name, fresh in https.items():
            serving = self._https[name]
            if serving is not None and fresh is not None:
                serving.adopt(fresh)
            else:
                self._https[name] = fresh
        self._replace_adapters(ports)
        logs.change(config.log.level, config.log.format)
        if self._audit is not None:
            self._audit.reopen()
            auditing.record(self._audit, "reload", config)

    def _taken_over_ports(self, config: Config, undo: ExitStack) -> dict[str, Port]:
        """The ports of the HTTP services: those at the same address stay, new ones are bound."""
        ports: dict[str, Port] = {}
        services = _http_services(self._config)
        for name, settings in _http_services(config).items():
            if name in services and services[name].bind == settings.bind:
                ports[name] = self._ports[name]
                continue
            ports[name] = Port(name, settings.bind.host, settings.bind.port)
            undo.callback(ports[name].close)
            ports[name].open()
        return ports

    def _device(
        self,
        name: str,
        config: Config,
        memories: Mapping[str, _core.Memory],
        values: TagValues | None,
    ) -> _core.PolledDevice:
        fence = self._leases.fence(name, config)
        return assembly.device(name, config, memories, _results(values), fence)

    def _replace_devices(self, before: Config, devices: Mapping[str, _core.PolledDevice]) -> None:
        """Removes, replaces and adds polled devices. `devices` are those with other settings."""
        polled = {name for name, device in before.devices.items() if device.is_polled}
        now = {name for name, device in self._config.devices.items() if device.is_polled}
        if self._poller is None:
            return
        for name in polled - now:
            self._poller.remove(name)
        for name, device in devices.items():
            if name in polled:
                self._poller.replace(name, device, at_once=False)
            else:
                self._poller.add(device)
        for name in [*(polled - now), *devices]:
            for told in (self._health, self._plan_errors, self._unstored):
                told.pop(name, None)
            self._forwarded = {key: at for key, at in self._forwarded.items() if key[0] != name}
            self._unreachable = {key for key in self._unreachable if key[0] != name}
        self._health |= dict.fromkeys(devices, "unknown")

    def _replace_adapters(self, ports: dict[str, Port]) -> None:
        """Stops the adapters with other settings, and starts those of the configuration."""
        parts = self._adapters(self._config, ports)
        ending = {
            name: supervisor
            for name, supervisor in self._supervisors.items()
            if name not in parts or parts[name].fingerprint != self._fingerprint_of[name]
        }
        for supervisor in ending.values():
            supervisor.stop()
        for name, supervisor in ending.items():
            supervisor.join()
            del self._supervisors[name], self.diagnostics.adapters[name]
        for name, port in self._ports.items():
            if ports.get(name) is not port:
                port.close()
        self._ports = ports
        for name, part in parts.items():
            if name not in self._supervisors:
                self._add(name, part)
                self._supervisors[name].start()

    def _tell_disabled(self) -> list[str]:
        """Writes the status blocks of disabled devices. Returns the names of these devices."""
        devices = self._config.devices
        disabled = [name for name, settings in devices.items() if not settings.enabled]
        for name in disabled:
            status = devices[name].status
            if status is not None:
                assembly.tell_disabled(name, status, self._memories)
        return disabled

    def endpoints(self) -> list[ListenAddress]:
        """Returns where listeners and HTTP services listen."""
        listeners = self._config.listeners.items()
        endpoints: list[ListenAddress] = []
        for (name, settings), address in zip(listeners, self._engine.addresses, strict=True):
            if isinstance(settings, ModbusRtuListener | ModbusAsciiListener):
                device = settings.serial.device
                endpoints.append(ListenAddress(name, settings.type, device, None, settings))
            elif address is not None:
                endpoints.append(ListenAddress(name, settings.type, *address, settings))
        for name, port in self._ports.items():
            service = getattr(self._config, name)
            scheme = "http" if service.tls is None else "https"
            endpoints.append(ListenAddress(name, scheme, *port.address, service, port.error))
        return endpoints

    def log_listening(self) -> None:
        """Logs the listeners and bound ports that were not logged yet."""
        before, self._listening = self._listening, {}
        for endpoint in self.endpoints():
            if endpoint.type in ("http", "https"):
                self._ports[endpoint.name].log_listening()
                continue
            host, port = at = self._listening[endpoint.name] = (endpoint.host, endpoint.port)
            if at != before.get(endpoint.name):
                logs.listening(endpoint.name, host if port is None else joined(host, port), port)

    def _adapters(self, config: Config, ports: Mapping[str, Port]) -> dict[str, _Part]:
        """The adapters of a configuration, by name."""
        parts: dict[str, _Part] = {}
        poller = self._poller

        def add(name: str, factory: Callable[[], Adapter], *settings: object) -> _Part:
            found = fingerprint(*settings, id(ports.get(name)))
            parts[name] = _Part(found, factory, port=ports.get(name))
            return parts[name]

        if config.rest is not None:
            from holdfast.adapters.rest import Rest

            rest, at, access = config.rest, ports["rest"], self._memory_access("rest")
            part = add(
                "rest",
                lambda: Rest(
                    rest, access, self.diagnostics, self, at.listener, https=self._https["rest"]
                ),
                *_apart_from_files(rest),
                sorted(self._memories),
            )
            parts["rest"] = replace(part, access=access)
        if config.mqtt is not None:
            from holdfast.adapters.mqtt import Mqtt

            mqtt, to_mqtt, mapped = config.mqtt, self._memory_access("mqtt"), config.mapped()
            tags = list(mapped.items())
            part = add("mqtt", lambda: Mqtt(mqtt, to_mqtt, mapped), mqtt, tags)
            parts["mqtt"] = replace(part, access=to_mqtt)
        if config.nats is not None:
            from holdfast.scanner.adapter import ScannerAdapter

            scanner = assembly.scanner(config.nats, config.profiles)
            starter = Starter()
            part = add(
                "nats",
                lambda: ScannerAdapter(scanner, poller, starter.start),
                config.nats,
                config.profiles,
            )
            parts["nats"] = replace(part, may_end=True, starter=starter)
        if config.gateway is not None:
            from holdfast.gateway import Gateway

            gateway = assembly.gateway(config.gateway, config.profiles)
            gateway_at = ports["gateway"]
            add(
                "gateway",
                lambda: Gateway(
                    gateway,
                    gateway_at.listener,
                    poller=poller,
                    https=self._https["gateway"],
                    health=self.health,
                ),
                *_apart_from_files(config.gateway),
                config.profiles,
                poller is None,
            )
        if config.metrics is not None:
            from holdfast.adapters.metrics import Metrics

            metrics, metrics_at = config.metrics, ports["metrics"]
            add(
                "metrics",
                lambda: Metrics(
                    metrics,
                    self.diagnostics,
                    self.health,
                    metrics_at.listener,
                    https=self._https["metrics"],
                ),
                *_apart_from_files(metrics),
            )
        for name, output in config.outputs.items():
            if self._values is not None:
                add(f"{OUTPUT}{name}", self._output(self._values, name, output), output)
        for name, settings in config.adapters.items():
            own = self._memory_access(name)
            part = add(name, foreign.factory(name, settings, own), settings)
            parts[name] = replace(part, access=own)
        return parts

    def _output(self, values: TagValues, name: str, settings: Output) -> Callable[[], Adapter]:
        if self._writes is None:
            assert self._poller is not None, "values come from a poller"
            self._writes = TagWrites(self._poller, self._audit, values.find)
        site = OutputSite(name, settings.devices, values, self._writes)
        return lambda: values.sending(name, receivers.receiver(name, settings, site))

    def _memory_access(self, name: str) -> MemoryAccess:
        """The way to memory of an adapter. It keeps its counters over reloads."""
        if name not in self._accesses:
            made = MemoryAccess(name, self._memories, self._audit, self._passages)
            self._accesses[name] = made
        return self._accesses[name]

    def _add(self, name: str, part: _Part) -> None:
        supervisor = Supervisor(
            name, part.factory, may_end=part.may_end, port=part.port, starter=part.starter
        )
        self._supervisors[name] = supervisor
        self._fingerprint_of[name] = part.fingerprint
        self.diagnostics.adapters[name] = (supervisor, part.access)


def _check_parts(config: Config) -> None:
    """Raises `UnknownAdapter` or `OSError` for what can be found before a socket is opened."""
    for name, settings in config.adapters.items():
        foreign.entry_point(name, settings)
    if config.gateway is not None and config.gateway.device_tls is not None:
        _check_files("gateway.device_tls", assembly.gateway_tls(config.gateway))


def _http_services(config: Config) -> dict[str, RestConfig | GatewayConfig | MetricsConfig]:
    services = {name: getattr(config, name) for name in HTTP_SERVICES}
    return {name: settings for name, settings in services.items() if settings is not None}


def _apart_from_files(service: RestConfig | GatewayConfig | MetricsConfig) -> tuple[object, bool]:
    """What an HTTP service must start again for: other certificates are for new connections."""
    return service.model_copy(update={"tls": None}), service.tls is None


def _requires_poller(config: Config) -> bool:
    polled = any(device.is_polled for device in config.devices.values())
    return bool(polled or config.links or routed(config) or config.nats is not None)


def _tag_values(
    known: TagValues | None, poller: _core.Poller | None, config: Config
) -> TagValues | None:
    """The thread that takes the values of tags, once there are some."""
    has_tags = any(device.is_polled and device.has_tags for device in config.devices.values())
    if known is None and poller is not None and has_tags:
        return TagValues(poller.receiver())
    return known


def _results(values: TagValues | None) -> _core.Results | None:
    return None if values is None else values.results


def _review_interval(config: Config) -> float | None:
    """Seconds after which the certificates of open connections are judged again."""
    found = map(tls_of, config.listeners.values())
    return min((tls.review for tls in found if tls is not None and tls.review), default=None)


def _events(config: Config) -> Literal["all", "refusals"]:
    """The events of listeners that are logged."""
    return "all" if config.log.level == "debug" else "refusals"


def _loaded_https(config: Config) -> dict[str, Https | None]:
    """The TLS settings of each HTTP service. Raises `OSError` with the setting's name."""
    loaded: dict[str, Https | None] = {}
    for name in HTTP_SERVICES:
        settings = getattr(config, name)
        tls = None if settings is None else settings.tls
        try:
            loaded[name] = None if tls is None else assembly.https(tls)
        except ValueError as error:
            raise OSError(f"{name}.tls: {error}") from error
    return loaded


def _check_files(name: str, tls: Tls) -> None:
    """Raises `OSError` with the setting's name if a file can't be used."""
    try:
        check_files(tls)
    except (OSError, ValueError) as error:
        raise OSError(f"{name}: {error}") from error
