"""Starts, replaces and stops services: supervised adapters, some with an HTTP port."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast import ingest
from holdfast.appliance.parts.listeners import ListenAddress
from holdfast.appliance.parts.part import Part
from holdfast.net.http.port import Port

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from holdfast._core import Memory
    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.adapters.sessions import SessionControl
    from holdfast.appliance.parts.audit import AuditLog
    from holdfast.appliance.parts.devices import Devices
    from holdfast.appliance.parts.part import Plan
    from holdfast.appliance.parts.shared_logs import SharedLogs
    from holdfast.appliance.services.supervision import Supervisor
    from holdfast.config import Config
    from holdfast.config.models.server_tls import HttpsConfig
    from holdfast.config.models.services import GatewayConfig, MetricsConfig, RestConfig
    from holdfast.ingest import MemoryAccess
    from holdfast.net.http.health import HealthSource
    from holdfast.net.http.https import Https
    from holdfast.types import ThreadHeartbeat

    HttpConfig = RestConfig | GatewayConfig | MetricsConfig


@dataclass(frozen=True)
class ServiceContext:
    """What services use of their appliance."""

    memories: Mapping[str, Memory]
    audit: AuditLog
    devices: Devices
    diagnostics: DiagnosticsSource
    health: HealthSource
    sessions: SessionControl
    logs: SharedLogs
    adapters: dict[str, Supervisor]
    """Those of all parts, by name."""


class HttpEndpoint:
    """The port and the certificates of an HTTP service."""

    def __init__(self, name: str, settings: HttpConfig) -> None:
        """Raises `OSError` with the name of the setting for an unusable file."""
        self.settings = settings
        self.port = Port(name, settings.bind.host, settings.bind.port)
        self.https: Https | None = None
        if settings.tls is not None:
            try:
                self.https = https(settings.tls)
            except ValueError as error:
                raise OSError(f"{name}.tls: {error}") from error

    def adopt(self, other: HttpEndpoint) -> None:
        """Takes over settings and certificates for the same address."""
        self.settings = other.settings
        if self.https is not None and other.https is not None:
            # Open connections keep their certificates, new ones have those of the reload.
            self.https.adopt(other.https)
        else:
            self.https = other.https

    @property
    def address(self) -> ListenAddress:
        """Where the service listens, or will listen."""
        scheme = "http" if self.settings.tls is None else "https"
        port = self.port
        return ListenAddress(port.name, scheme, *port.address, self.settings, port.error)

    @property
    def restart_settings(self) -> tuple[object, ...]:
        """What the service must restart for: other certificates need no restart."""
        return self.settings.model_copy(update={"tls": None}), self.settings.tls is None


class Service:
    """A kind of service. `Services` has the running adapters.

    The library of a service is imported only where the service is configured.
    """

    http: str | None = None
    """The section of the configuration, if it has an HTTP port."""

    def check(self, config: Config) -> None:
        """Raises `OSError` or `UnknownAdapter` for what can't work."""

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields the adapters of a configuration, which are not started."""
        raise NotImplementedError


class Services(Part):
    """The adapters of several services, which are replaced at the same time."""

    def __init__(self, config: Config, context: ServiceContext, *services: Service) -> None:
        super().__init__(config)
        self.context = context
        self._services = services
        self._adapters = context.adapters
        self._running: dict[str, Supervisor] = {}
        self._accesses: dict[str, MemoryAccess] = {}
        self.endpoints = self._checked(config)
        """By the name of the HTTP service."""

    def open(self, plan: Plan) -> None:
        """Binds the ports, or tries it once: adapters retry it."""
        for endpoint in self.endpoints.values():
            if plan.retries_ports:
                endpoint.port.try_bind()
            else:
                endpoint.port.bind()

    def start(self) -> None:
        """Starts the adapters."""
        self._replace(self.endpoints)

    def prepare(self, plan: Plan) -> Callable[[], None]:
        """Binds new addresses."""
        endpoints = self._checked(plan.config)
        adopted: list[tuple[HttpEndpoint, HttpEndpoint]] = []
        for name, endpoint in endpoints.items():
            known = self.endpoints.get(name)
            if known is not None and known.settings.bind == endpoint.settings.bind:
                adopted.append((known, endpoint))
                endpoints[name] = known
            else:
                plan.undo.callback(endpoint.port.close)
                endpoint.port.bind()

        def adopt() -> None:
            for known, endpoint in adopted:
                known.adopt(endpoint)
            self._replace(endpoints)

        return adopt

    def stop(self) -> None:
        """Requests the stop of all adapters."""
        for adapter in self._running.values():
            adapter.stop()

    def close(self) -> None:
        """Stops all adapters, and frees the ports."""
        self._end(self._running.values())
        for endpoint in self.endpoints.values():
            endpoint.port.close()

    def heartbeats(self) -> list[ThreadHeartbeat]:
        """The heartbeats of the adapters."""
        found = [adapter.heartbeat() for adapter in list(self._running.values())]
        return [each for each in found if each is not None]

    def memory_access(self, name: str) -> MemoryAccess:
        """The way to memory of an adapter. It keeps its counters over reloads."""
        if name not in self._accesses:
            of = self.context
            self._accesses[name] = ingest.MemoryAccess(
                name, of.memories, of.audit.log, of.devices.passages
            )
        return self._accesses[name]

    def _checked(self, config: Config) -> dict[str, HttpEndpoint]:
        """The endpoints of a configuration. Nothing is bound."""
        for service in self._services:
            service.check(config)
        names = [service.http for service in self._services if service.http is not None]
        found = {name: getattr(config, name) for name in names}
        return {
            name: HttpEndpoint(name, settings)
            for name, settings in found.items()
            if settings is not None
        }

    def _replace(self, endpoints: dict[str, HttpEndpoint]) -> None:
        """Stops the adapters with other settings, and starts those of the configuration."""
        before, self.endpoints = self.endpoints, endpoints
        adapters = {
            adapter.name: adapter
            for service in self._services
            for adapter in service.adapters(self.config, self)
        }
        ended = {
            name: adapter
            for name, adapter in self._running.items()
            if name not in adapters or adapters[name].fingerprint != adapter.fingerprint
        }
        self._end(ended.values())
        for name in ended:
            del self._running[name], self._adapters[name]
        for name, endpoint in before.items():
            if endpoints.get(name) is not endpoint:
                endpoint.port.close()
        for name, adapter in adapters.items():
            if name not in self._running:
                self._running[name] = self._adapters[name] = adapter
                adapter.start()

    def _end(self, adapters: Collection[Supervisor]) -> None:
        """Stops adapters at the same time, and waits for them."""
        for adapter in adapters:
            adapter.stop()
        for adapter in adapters:
            adapter.join()


class LastServices(Services):
    """Services that stop after all other parts."""

    closing_rank = 2

    def stop(self) -> None:
        """Goes on: `close` stops them."""


def https(settings: HttpsConfig) -> Https:
    """Loads the certificates of an HTTP service. Raises `ValueError` for an unusable file."""
    from holdfast.net.http.https import Https, HttpsFiles

    return Https(HttpsFiles(**dict(settings)))
