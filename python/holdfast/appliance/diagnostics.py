"""The diagnostics of a running appliance, for REST, metrics and logs."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from holdfast import logs
from holdfast.appliance.configured_certificates import Expiries

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast._core import Engine, Link, Memory, Poller
    from holdfast.appliance.device_leases import DeviceLeases
    from holdfast.appliance.kept import KeptMemories
    from holdfast.appliance.liveness import Liveness
    from holdfast.appliance.mirrors import Mirrors
    from holdfast.appliance.shared_logs import SharedLogs
    from holdfast.appliance.supervision import Supervisor
    from holdfast.appliance.tag_values import TagValues
    from holdfast.audit import Audit
    from holdfast.ingest import MemoryAccess
    from holdfast.polling import Reading


def configured(poller: Poller) -> dict[str, dict[str, Any]]:
    """The counters of the devices in the configuration. Those of the scanner have a slash."""
    return {name: told for name, told in poller.counters().items() if "/" not in name}


class Diagnostics:
    """Reads counters and states of a running appliance. Thread-safe; changes nothing."""

    def __init__(self, memories: Mapping[str, Memory], engine: Engine, liveness: Liveness) -> None:
        self._memories = memories
        self._engine = engine
        self._liveness = liveness
        self._began = time.monotonic()
        self.adapters: dict[str, tuple[Supervisor, MemoryAccess | None]] = {}
        self.kept: KeptMemories | None = None
        """The files that keep memories."""

        self.logs: SharedLogs | None = None
        """The logs that memories are replicated through."""

        self.leases: DeviceLeases | None = None
        """Who polls the devices that are read into replicated memories."""

        self.audit: Audit | None = None
        self.poller: Poller | None = None
        self.values: TagValues | None = None
        self.links: Mapping[str, Link] = {}
        """What listeners pass requests on to."""
        self.mirrors: Mirrors | None = None
        """What devices are read into."""

        self.disabled: Sequence[str] = ()
        """Devices that are not polled."""

        self.expiries = Expiries()
        """When the configured certificates expire."""

    def memories(self) -> dict[str, Any]:
        """Returns, for each memory, the start and size of its areas and the state of its seal."""
        return {
            name: {
                "areas": {
                    area: {"start": addresses.start, "size": len(addresses)}
                    for area, addresses in memory.areas.items()
                },
                "sealed": memory.sealed,
                "opened": memory.seal_changes[0],
                "closed": memory.seal_changes[1],
            }
            for name, memory in self._memories.items()
        }

    def stats(self) -> dict[str, Any]:
        """Returns all counters: of listeners, devices, links, adapters, logs, threads, files."""
        return {
            "uptime": round(time.monotonic() - self._began, 3),
            "listeners": self._engine.counters(),
            "devices": self.devices(),
            "links": {name: link.counters() for name, link in self.links.items()},
            "adapters": {name: self.adapter(name) for name in self.adapters},
            "events_lost": self._engine.lost_events,
            "log_dropped": logs.dropped(),
            "memory_files": {} if self.kept is None else self.kept.status(),
            "logs": self.shared_logs(),
            "audit": None if self.audit is None else self.audit.counts(),
            "threads": self._liveness.threads(),
            "certificates": self.expiries.certificates,
            "revocation_lists": self.expiries.revocation_lists,
        }

    def shared_logs(self) -> dict[str, dict[str, Any]]:
        """Returns the state of each log that memories are replicated through."""
        if self.logs is None:
            return {}
        found = self.logs.status()
        for name, status in found.items():
            status["devices"] = {} if self.leases is None else self.leases.status(name)
        return found

    def devices(self) -> dict[str, dict[str, Any]]:
        """Returns the health and the counters of each device."""
        polled = {} if self.poller is None else configured(self.poller)
        found = {**polled, **{name: {"health": "disabled"} for name in self.disabled}}
        aging = {} if self.mirrors is None else self.mirrors.status()
        for name in found.keys() & aging.keys():
            found[name]["mirrors"] = aging[name]
        return found

    def tag_values(self) -> list[Reading]:
        """Returns the last reading of each tag of the configured devices."""
        return [] if self.values is None else self.values.latest()

    def adapter(self, name: str) -> dict[str, Any] | None:
        """Returns the state and the counters of one adapter; `None` if it does not exist."""
        if name not in self.adapters:
            return None
        supervisor, memory_access = self.adapters[name]
        counts = {} if memory_access is None else memory_access.counts()
        return {**supervisor.status(), **counts}
