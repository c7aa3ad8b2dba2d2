"""The gateway: serves Modbus devices over HTTP."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.appliance.client_credentials import tls_files
from holdfast.appliance.services.services import Service
from holdfast.appliance.services.supervision import Supervisor
from holdfast.client.endpoint import check_files

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.appliance.services.services import Services
    from holdfast.config import Config
    from holdfast.config.models.services import GatewayConfig
    from holdfast.config.models.tags import ProfileConfig
    from holdfast.gateway import Settings


class GatewayService(Service):
    """The service of the section `gateway`."""

    http = "gateway"

    def check(self, config: Config) -> None:
        """Raises `OSError` if the certificates for devices can't be used."""
        if config.gateway is not None and config.gateway.device_tls is not None:
            try:
                check_files(config.gateway.device_tls.files)
            except (OSError, ValueError) as error:
                raise OSError(f"gateway.device_tls: {error}") from error

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields the adapter, if configured."""
        if config.gateway is None:
            return
        from holdfast.gateway import Gateway

        settings = gateway_settings(config.gateway, config.profiles)
        at, context = running.endpoints["gateway"], running.context
        poller = context.devices.poller
        yield Supervisor(
            "gateway",
            lambda: Gateway(
                settings, at.port.listener, poller=poller, https=at.https, health=context.health
            ),
            # A reload may create the poller, whose connections the gateway shares.
            *at.restart_settings,
            config.profiles,
            poller is None,
            port=at.port,
        )


def gateway_settings(
    settings: GatewayConfig, profiles: Mapping[str, ProfileConfig] | None = None
) -> Settings:
    """Returns the settings of the gateway."""
    from holdfast.gateway import GatewayLimits, Settings

    tokens = () if settings.tokens == "none" else settings.tokens
    return Settings(
        settings.allow,
        writes=settings.access == "read-write",
        tokens=tuple((token.name, bytes.fromhex(token.sha256)) for token in tokens),
        sources=settings.sources,
        limits=GatewayLimits(
            in_flight=settings.in_flight,
            connections=settings.max_connections,
            connections_per_source=settings.max_connections_per_source,
        ),
        profiles={name: profile.tag_list for name, profile in (profiles or {}).items()},
        hosts=frozenset(settings.hosts),
        compat=settings.compat,
        tls=tls_files(settings.device_tls),
    )
