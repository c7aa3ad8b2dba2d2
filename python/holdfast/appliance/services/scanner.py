"""The scanner: polls devices for subscribers on NATS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.appliance.client_credentials import nats_servers, tls_files
from holdfast.appliance.services.services import Service
from holdfast.appliance.services.supervision import Starter, Supervisor

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.appliance.services.services import Services
    from holdfast.config import Config
    from holdfast.config.models.services import NatsConfig
    from holdfast.config.models.tags import ProfileConfig
    from holdfast.scanner.adapter import ScannerAdapter
    from holdfast.scanner.messages.types import SubscriptionRequest
    from holdfast.scanner.settings import Settings


class ScannerService(Service):
    """The service of the section `nats`."""

    def __init__(self) -> None:
        self._former: tuple[ScannerAdapter, Settings] | None = None
        """The last scanner: one that takes its place begins with its subscriptions."""

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields the adapter, if configured."""
        if config.nats is None:
            self._former = None  # What clients want may be something else when there is one again.
            return
        from holdfast.scanner.adapter import ScannerAdapter

        settings = scanner_settings(config.nats, config.profiles)
        starter, poller = Starter(), running.context.devices.poller

        def adapter() -> ScannerAdapter:
            former: list[SubscriptionRequest] = []
            if self._former is not None:
                before, of = self._former
                if _clients(of) == _clients(settings):
                    former = before.subscriptions
            made = ScannerAdapter(settings, poller, starter.start, former)
            self._former = made, settings
            return made

        yield Supervisor(
            "nats",
            adapter,
            config.nats,
            config.profiles,
            may_end=True,
            starter=starter,
        )


def _clients(settings: Settings) -> tuple[object, ...]:
    """Whom a scanner serves: subscriptions of others are not theirs."""
    return settings.prefix, settings.dialect, settings.servers.urls, settings.fleet


def scanner_settings(
    settings: NatsConfig, profiles: Mapping[str, ProfileConfig] | None = None
) -> Settings:
    """Returns the settings of the scanner."""
    from holdfast.net.nats.connection import Ping
    from holdfast.scanner.settings import FleetSettings, Settings
    from holdfast.scanner.subscriptions.request_rules import Defaults, ScannerLimits

    fleet, given = settings.fleet, settings.defaults
    return Settings(
        nats_servers(settings),
        settings.prefix,
        settings.devices,
        ScannerLimits(devices=settings.limits.devices, tags=settings.limits.tags),
        tls_files(settings.device_tls),
        defaults=Defaults(given.timeout, given.publish, given.deadband, given.scan_rate),
        writes=settings.writes,
        strict=settings.strict,
        ping=Ping(settings.ping.interval, settings.ping.outstanding),
        publish_logs=settings.publish_logs,
        keep_subscriptions=settings.keep_subscriptions,
        dialect=settings.dialect,
        profiles={name: profile.tag_list for name, profile in (profiles or {}).items()},
        fleet=None if fleet is None else FleetSettings(fleet.name, fleet.node, fleet.partitions),
    )
