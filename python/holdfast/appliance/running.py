"""The appliance starts, logs and stops the memories, listeners, devices and adapters.

It only connects these parts. It parses no protocol, and takes no part in answering requests.
"""

from __future__ import annotations

import logging
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from holdfast import _core, logs
from holdfast.adapters import foreign
from holdfast.appliance import assembly, configured_certificates
from holdfast.appliance.diagnostics import Diagnostics
from holdfast.appliance.supervision import Supervisor
from holdfast.client.endpoint import check_files
from holdfast.config import HTTP_SERVICES, ModbusAsciiListener, ModbusRtuListener
from holdfast.config.route_checks import routed
from holdfast.faults import fault_word
from holdfast.ingest import MemoryAccess
from holdfast.ingest.audit import Audit
from holdfast.net.addresses import joined
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
    from holdfast.web.https import Https

# All other events of a listener are refusals or faults.
LEVELS = {
    "opened": logging.DEBUG,
    "closed": logging.DEBUG,
    "idle": logging.DEBUG,
    "line_back": logging.INFO,
}

# The most writes that are moved to the audit log at once.
AUDIT_BATCH = 1000

# Seconds between checks of the health of devices.
HEALTH_CHECK_INTERVAL = 1.0

# Seconds that a thread waits for the next write before it checks for a stop.
WAIT_TIMEOUT = 0.2


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
    not keep Modbus from starting.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.memories = {
            name: assembly.memory(settings) for name, settings in config.memories.items()
        }
        self._running: _Running | None = None

    def start(self) -> Self:
        """Binds the listeners and serves. Raises `RuntimeError` if already running."""
        if self._running is not None:
            raise RuntimeError("the appliance is already running")
        self._running = _Running(self.config, self.memories)
        for endpoint in self.endpoints():
            if endpoint.error is not None:
                continue
            host, port = endpoint.host, endpoint.port
            address = host if port is None else joined(host, port)
            logs.write(logging.INFO, "listening", listener=endpoint.name, address=address)
        return self

    def stop(self) -> None:
        """Answers the requests already received, then stops."""
        running, self._running = self._running, None
        if running is not None:
            running.stop()
            logs.write(logging.INFO, "stopped")

    @property
    def diagnostics(self) -> Diagnostics:
        """The diagnostics. Raises `RuntimeError` if not running."""
        return self._parts().diagnostics

    def endpoints(self) -> list[ListenAddress]:
        """Returns the addresses of all listeners and services, in configuration order."""
        return self._parts().endpoints()

    def reload_https(self, config: Config) -> None:
        """Loads the certificates of HTTPS services in `config`, for new connections.

        Raises `OSError` with the setting's name and changes nothing if a file can't be used. A
        service that has begun with HTTP stays with HTTP.
        """
        self._parts().reload_https(config)

    def log_events(self, timeout: float) -> None:
        """Waits up to `timeout` seconds for a listener event and logs it.

        Also logs changes of seals and of the health of devices.
        """
        self._parts().log_events(timeout)

    def _parts(self) -> _Running:
        if self._running is None:
            raise RuntimeError("the appliance is not running")
        return self._running

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()


class _Running:
    """The parts of a running appliance. The constructor starts all of them or none."""

    def __init__(self, config: Config, memories: dict[str, _core.Memory]) -> None:
        self._config = config
        self._memories = memories
        self._supervisors: list[Supervisor] = []
        self._lost_events = 0
        self._seals = {name: memory.seal_changes for name, memory in memories.items()}
        self._health = dict.fromkeys(config.devices, "unknown")
        self._plan_errors: dict[str, str | None] = {}
        self._unstored: dict[str, int] = {}
        self._forwarded: dict[tuple[str, int], Mapping[str, int]] = {}
        self._unreachable: set[tuple[str, int]] = set()
        self._looked = time.monotonic()
        # Missing adapters and unusable TLS files are reported before any socket is opened.
        for name, settings in config.adapters.items():
            foreign.entry_point(name, settings)
        if config.gateway is not None and config.gateway.device_tls is not None:
            _check_files("gateway.device_tls", assembly.gateway_tls(config.gateway))
        self._https = _loaded_https(config)
        assembly.mirror(config, memories)
        devices = [
            assembly.device(name, config, memories)
            for name, device in config.devices.items()
            if device.is_polled
        ]
        disabled = self._tell_disabled()
        with ExitStack() as undo:
            self._audit = self._opened_audit(undo)
            self._ports = self._bound_ports(undo)
            # The links of listeners come first: the first use of an address decides its settings.
            self._poller: _core.Poller | None = None
            links = assembly.Links()
            if devices or config.links or routed(config) or config.nats is not None:
                self._poller = _core.Poller([])
                undo.callback(self._poller.stop)
                links = assembly.links(config, memories, self._poller)
            self._engine = self._started_engine(links)
            self._passages = links.passages
            undo.callback(self._engine.stop)
            if self._poller is not None:
                for device in devices:
                    self._poller.add(device)
            self.diagnostics = Diagnostics(memories, self._engine)
            self.diagnostics.audit = self._audit
            self.diagnostics.poller = self._poller
            self.diagnostics.links = links.links
            self.diagnostics.disabled = disabled
            self.diagnostics.expiries = configured_certificates.expiries(config)
            self._add_adapters(self._ports)
            undo.pop_all()
        self._auditing = threading.Thread(target=self._take_writes, name="holdfast-audit")
        self._stopped = threading.Event()
        if self._audit is not None:
            self._auditing.start()
        for supervisor in self._supervisors:
            supervisor.start()

    def stop(self) -> None:
        """Requests the stop of all parts, then waits for each.

        Links stop after all that use them: listeners and the gateway still answer the requests that
        they have passed on.
        """
        for supervisor in self._supervisors:
            supervisor.stop()
        self._engine.stop()
        self._stopped.set()
        for supervisor in self._supervisors:
            supervisor.join()
        if self._poller is not None:
            self._poller.stop()
        for port in self._ports.values():
            port.close()
        if self._audit is not None:
            self._auditing.join()
            self._audit.close()

    def reload_https(self, config: Config) -> None:
        loaded = _loaded_https(config)
        for name, https in self._https.items():
            fresh = loaded[name]
            if https is not None and fresh is not None:
                https.adopt(fresh)
        self.diagnostics.expiries = configured_certificates.expiries(config)

    def log_events(self, timeout: float) -> None:
        event = self._engine.next_event(timeout)
        if event is not None:
            self._log_event(*event)
        lost = self._engine.lost_events
        if lost > self._lost_events:
            logs.write(logging.WARNING, "events_lost", count=lost - self._lost_events)
            self._lost_events = lost
        for name, memory in self._memories.items():
            before, now = self._seals[name], memory.seal_changes
            if now != before:
                self._seals[name] = now
                opened, closed = now[0] - before[0], now[1] - before[1]
                state = "sealed" if memory.sealed else "open"
                logs.write(
                    logging.INFO, "seal", memory=name, state=state, opened=opened, closed=closed
                )
        if time.monotonic() - self._looked < HEALTH_CHECK_INTERVAL:
            return
        self._looked = time.monotonic()
        logs.tell_held_back()
        if self._poller is not None:
            for name, told in self._poller.counters(report=False).items():
                self._log_device(name, told)

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
        logs.write(logging.INFO if health == "ok" else logging.WARNING, "device_health", **fields)

    def _log_forwards(self, name: str, counted: Sequence[Mapping[str, int]]) -> None:
        """Logs what happened at the receivers of a device since the last check."""
        receivers = self._config.devices[name].forward
        for index, (receiver, now) in enumerate(zip(receivers, counted, strict=True)):
            key = (name, index)
            before = self._forwarded.get(key, {})
            self._forwarded[key] = now
            refused = now["refused"] - before.get("refused", 0)
            replied = refused + now["sent"] - before.get("sent", 0)
            failed = now["failed"] - before.get("failed", 0)
            fields = {"device": name, "receiver": receiver.url}
            if refused:
                logs.refused("forward_refused", kind=key, **fields, count=refused)
            if replied and key in self._unreachable:
                self._unreachable.discard(key)
                logs.write(logging.INFO, "forward_back", **fields)
            elif failed and not replied and key not in self._unreachable:
                self._unreachable.add(key)
                logs.write(logging.WARNING, "forward_failed", **fields)

    def _log_event(
        self, listener: str, event: str, peer: str | None, reason: str | None, count: int | None
    ) -> None:
        fields: dict[str, object] = {"listener": listener, "peer": peer or "-"}
        if reason is not None:
            fields["role" if event == "refused_role" else "reason"] = reason
        if count is not None:
            fields["bytes"] = count
        if event in LEVELS:
            logs.write(LEVELS[event], event, **fields)
        else:
            logs.refused(event, kind=(listener, reason), **fields)

    def _opened_audit(self, undo: ExitStack) -> Audit | None:
        settings = self._config.audit
        if settings is None:
            return None
        audit = Audit(settings.file, max_bytes=settings.max_bytes, keep=settings.keep)
        undo.callback(audit.close)
        return audit

    def _bound_ports(self, undo: ExitStack) -> dict[str, Port]:
        """Tries to bind the ports of the HTTP services. The others are tried again later."""
        ports: dict[str, Port] = {}
        config = self._config
        for name in HTTP_SERVICES:
            settings = getattr(config, name)
            if settings is not None:
                ports[name] = Port(name, settings.bind.host, settings.bind.port)
                undo.callback(ports[name].close)
                ports[name].bind()
        return ports

    def _started_engine(self, links: assembly.Links) -> _core.Engine:
        config = self._config
        identity = assembly.identity(config.identity)
        return _core.Engine(
            [assembly.listener(name, config, self._memories, links) for name in config.listeners],
            identity=identity.objects(),
            unit_names=identity.names(),
            workers=config.workers,
            events="all" if config.log.level == "debug" else "refusals",
            audit=self._audit is not None,
        )

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

    def _add_adapters(self, ports: Mapping[str, Port]) -> None:
        config = self._config
        if config.rest is not None:
            from holdfast.adapters.rest import Rest

            rest, memory_access = config.rest, self._memory_access("rest")
            at = ports["rest"]
            self._add(
                "rest",
                memory_access,
                lambda: Rest(
                    rest, memory_access, self.diagnostics, at.listener, https=self._https["rest"]
                ),
                port=at,
            )
        if config.mqtt is not None:
            from holdfast.adapters.mqtt import Mqtt

            mqtt, to_mqtt = config.mqtt, self._memory_access("mqtt")
            self._add("mqtt", to_mqtt, lambda: Mqtt(mqtt, to_mqtt))
        if config.nats is not None:
            from holdfast.scanner.adapter import ScannerAdapter

            scanner, poller = assembly.scanner(config.nats), self._poller
            self._add("nats", None, lambda: ScannerAdapter(scanner, poller), may_end=True)
        if config.gateway is not None:
            from holdfast.gateway import Gateway

            gateway, gateway_at = assembly.gateway(config.gateway), ports["gateway"]
            self._add(
                "gateway",
                None,
                lambda: Gateway(
                    gateway,
                    gateway_at.listener,
                    poller=self._poller,
                    https=self._https["gateway"],
                ),
                port=gateway_at,
            )
        if config.metrics is not None:
            from holdfast.adapters.metrics import Metrics

            metrics, metrics_at = config.metrics, ports["metrics"]
            self._add(
                "metrics",
                None,
                lambda: Metrics(
                    metrics, self.diagnostics, metrics_at.listener, https=self._https["metrics"]
                ),
                port=metrics_at,
            )
        for name, settings in config.adapters.items():
            own_door = self._memory_access(name)
            self._add(name, own_door, foreign.factory(name, settings, own_door))

    def _memory_access(self, name: str) -> MemoryAccess:
        return MemoryAccess(name, self._memories, self._audit, self._passages)

    def _add(
        self,
        name: str,
        memory_access: MemoryAccess | None,
        factory: Callable[[], Adapter],
        *,
        may_end: bool = False,
        port: Port | None = None,
    ) -> None:
        supervisor = Supervisor(name, factory, may_end=may_end, port=port)
        self._supervisors.append(supervisor)
        self.diagnostics.adapters[name] = (supervisor, memory_access)

    def _take_writes(self) -> None:
        """Moves the writes of listeners to the audit log until the appliance has stopped."""
        audit, lost = self._audit, 0
        assert audit is not None
        while True:
            ended = self._stopped.is_set()
            writes = self._engine.next_writes(0 if ended else WAIT_TIMEOUT, AUDIT_BATCH)
            audit.write_all(writes)
            missed = self._engine.lost_writes
            if missed > lost:
                audit.write(lost=missed - lost)
                logs.write(logging.ERROR, "audit_lost", count=missed - lost)
                lost = missed
            if ended and not writes:
                return


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
