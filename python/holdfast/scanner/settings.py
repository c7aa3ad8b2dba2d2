"""The settings of a scanner."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.config.values.scanner_settings import PARTITIONS, written_pollable
from holdfast.net.nats.connection import MAX_PAUSE_S, Ping, Servers
from holdfast.net.tls import NO_FILES, Tls
from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from holdfast.runtime.standstill import STANDSTILL_S
from holdfast.scanner.dialects import DIALECTS
from holdfast.scanner.jetstream.key_watch import WATCH_TIMES, WatchTimes
from holdfast.scanner.subscriptions.request_rules import Defaults, ScannerLimits
from holdfast.scanner.subscriptions.write_access import described

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from holdfast.config.values import scanner_settings
    from holdfast.net.allow_list import AllowEntry
    from holdfast.tags import TagList


def places(allow: Iterable[AllowEntry]) -> str:
    """Where devices may be."""
    return ", ".join(map(written_pollable, allow)) or "at private and loopback addresses"


@dataclass(frozen=True)
class FleetSettings:
    """The fleet that a scanner is a part of."""

    name: str
    node: str
    """The name of this scanner in the fleet; unique."""
    partitions: int = PARTITIONS
    lease_times: LeaseTimes = LEASE_TIMES
    """The same for all nodes, or two of them use a device."""
    check_interval_s: float = 5.0
    """Between checks whether changes of subscriptions still arrive."""


@dataclass(frozen=True)
class Settings:
    """The settings of a scanner."""

    servers: Servers = field(default_factory=Servers)
    prefix: str = "modbus"
    """The first part of all subjects, and the id of the module in messages."""
    allow: tuple[AllowEntry, ...] = ()
    """Networks and serial devices, see `AllowedDevices`."""
    limits: ScannerLimits = field(default_factory=ScannerLimits)
    device_tls: Tls = NO_FILES
    """The TLS files for connections to devices."""
    defaults: Defaults = field(default_factory=Defaults)
    """What subscribe requests leave out."""
    writes: scanner_settings.Writes = "tags"
    """Which tags callers may write."""
    strict: bool = False
    """Whether requests are refused that would otherwise be adjusted."""
    ping: Ping = field(default_factory=Ping)
    """How a NATS server that does not answer is detected."""
    max_pause_s: float = MAX_PAUSE_S
    """Between attempts to connect to NATS."""
    publish_logs: bool = True
    """Whether the log is also published."""
    keep_subscriptions: bool = True
    """Whether subscriptions and states are kept in JetStream."""
    dialect: scanner_settings.Dialect = "tentacle"
    """The programs that it serves."""
    profiles: Mapping[str, TagList] = field(default_factory=dict)
    """The tags that requests can name by their profile."""
    fleet: FleetSettings | None = None
    """The fleet of scanners that it is a node of."""
    exact_pauses_s: tuple[float, float] | None = None
    """Instead of `reconnect_pauses_s` of the dialect."""
    watch_times: WatchTimes = WATCH_TIMES
    """Those of the buckets of tentacle-next."""
    standstill_s: float = STANDSTILL_S
    """The shortest time without the event loop after which commands that waited are refused."""

    @property
    def write_access(self) -> dict[str, str]:
        """What may be written, where, by whom, and what narrows it, in words."""
        commands = DIALECTS[self.dialect].command_subjects
        subjects = [f"{self.prefix}.{each}" for each in ("subscribe", *commands)]
        return described(self.writes, places(self.allow), subjects)
