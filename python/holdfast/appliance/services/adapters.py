"""The services of other protocols: REST, MQTT, metrics, and adapters of other packages."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from holdfast.adapters import plugins
from holdfast.appliance.services.services import Service
from holdfast.appliance.services.supervision import Supervisor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.appliance.services.services import Services
    from holdfast.config import Config


class RestService(Service):
    """The section `rest`."""

    http = "rest"

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields the adapter, if there is the section."""
        if (settings := config.rest) is None:
            return
        from holdfast.adapters.rest import Rest

        of, at, access = running.context, running.endpoints["rest"], running.memory_access("rest")
        yield Supervisor(
            "rest",
            lambda: Rest(
                settings, access, of.diagnostics, of.sessions, at.port.listener, https=at.https
            ),
            *at.restart_settings,
            # Without tokens, everyone may read all memories. A token names its own.
            sorted(of.memories) if settings.tokens == "none" else (),
            access=access,
            port=at.port,
        )


class MqttService(Service):
    """The section `mqtt`."""

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields the adapter, if there is the section."""
        if (settings := config.mqtt) is None:
            return
        from holdfast.adapters.mqtt import Mqtt

        access, mapped = running.memory_access("mqtt"), config.mqtt_tags()
        factory = partial(Mqtt, settings, access, mapped, running.context.logs.restored)
        yield Supervisor("mqtt", factory, settings, list(mapped.items()), access=access)


class MetricsService(Service):
    """The section `metrics`."""

    http = "metrics"

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields the adapter, if there is the section."""
        if (settings := config.metrics) is None:
            return
        from holdfast.adapters.metrics import Metrics

        of, at = running.context, running.endpoints["metrics"]
        yield Supervisor(
            "metrics",
            lambda: Metrics(settings, of.diagnostics, of.health, at.port.listener, https=at.https),
            *at.restart_settings,
            port=at.port,
        )


class ForeignAdapters(Service):
    """The section `adapters`."""

    def check(self, config: Config) -> None:
        """Raises `UnknownAdapter` if one is not installed."""
        for name, settings in config.adapters.items():
            plugins.entry_point(name, settings)

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields all adapters."""
        for name, settings in config.adapters.items():
            access = running.memory_access(name)
            yield Supervisor(name, plugins.factory(name, settings, access), settings, access=access)
