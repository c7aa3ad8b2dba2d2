"""Which of the appliances of a log polls each device that is read into a replicated memory.

One lease for each address, because devices behind it share a connection. Whoever has it polls, all
others stand by. The thread of a log holds the leases. The native poller uses a device while
its fence is open. A node whose log does not take what it polls renews no lease, so that others
take them.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

from holdfast.appliance.client_credentials import nats_servers
from holdfast.appliance.parts.part import Part
from holdfast.client.url import connection_of
from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from holdfast import _core
    from holdfast.appliance.parts.part import Plan
    from holdfast.appliance.parts.shared_logs import SharedLogs
    from holdfast.config import Config
    from holdfast.replication.leases.bucket import Holding
    from holdfast.replication.leases.times import LeaseTimes
    from holdfast.types import ThreadHeartbeat

_GIVE_BACK_TIMEOUT_S = 2.0
"""How long to wait for polls and writes in progress before a lease is given back."""


def leased(config: Config) -> dict[str, str]:
    """The logs of devices that only one node polls, by device."""
    logs = ((device, _log_of(config, device)) for device in config.devices)
    return {device: log for device, log in logs if log is not None}


def _log_of(config: Config, name: str) -> str | None:
    """The log of the first replicated memory that a device is read into."""
    device = config.devices[name]
    if not device.is_polled:
        return None
    memories = [read.into.memory for read in device.reads if read.into is not None]
    if device.status is not None:
        memories.append(device.status.memory)
    replicated = (config.memories[memory].replicate for memory in memories)
    return next((each.log for each in replicated if each is not None), None)


def key_of(config: Config, device: str) -> str:
    """The key of the lease of a device: its address, in characters that a key may have."""
    return connection_of(config.devices[device].target).encode().hex()


def _has(holder: Holding, device: str) -> bool:
    """Whether the holder of an address has a device there. Without a list, it has all of them."""
    devices = holder.about.get("devices")
    return not isinstance(devices, list) or device in devices


class DeviceLeases(Part):
    """The leases of all logs of a configuration."""

    def __init__(self, config: Config, logs: SharedLogs, times: LeaseTimes | None) -> None:
        super().__init__(config)
        self._shared_logs = logs
        logs_used = set(leased(config).values()) | {
            memory.replicate.log for memory in config.memories.values() if memory.replicate
        }
        self._of_log = {
            name: _LogLeases(name, config, times, logs.obstacle) for name in sorted(logs_used)
        }

    def fence(self, device: str, config: Config) -> _core.Fence | None:
        """The fence of a device; `None` if every node polls it."""
        log = _log_of(config, device)
        return None if log is None else self._of_log[log].leases.fence(key_of(config, device))

    def prepare(self, plan: Plan) -> Callable[[], None]:
        """Holds leases for the devices of the configuration, gives those of removed ones back."""
        return lambda: self._adopt(plan.config)

    def _adopt(self, config: Config) -> None:
        logs = leased(config)
        for name, of_log in self._of_log.items():
            devices: dict[str, list[str]] = {}
            for device, log in logs.items():
                if log == name:
                    devices.setdefault(key_of(config, device), []).append(device)
            of_log.adopt(devices)

    def start(self) -> None:
        """Begins to take leases."""
        for of_log in self._of_log.values():
            of_log.start()

    def stats(self) -> Mapping[str, Any]:
        """The state of each log, with those who poll its devices. Thread-safe."""
        # Each log with memories has leases, also without devices.
        found = self._shared_logs.status()
        return {
            "logs": {
                name: {**status, "devices": self._of_log[name].status()}
                for name, status in found.items()
            }
        }

    def unpolled(self) -> dict[str, str]:
        """The devices that no node polls, and why. Those of which a lease may be taken soon are not
        among them. Thread-safe.
        """
        found: dict[str, str] = {}
        for of_log in self._of_log.values():
            found |= of_log.unpolled()
        return found

    def heartbeats(self) -> list[ThreadHeartbeat]:
        """The heartbeats of the threads. Thread-safe."""
        found = (of_log.heartbeat() for of_log in self._of_log.values())
        return [each for each in found if each is not None]

    def close(self) -> None:
        """Gives all leases back, while devices are still polled."""
        for of_log in self._of_log.values():
            of_log.stop()


class _State(Enum):
    """Whether the thread of a log's leases runs."""

    STOPPED = "not started, or stopped"
    IDLE = "started, and there are no devices"
    RUNNING = "there are devices, or there were"


@dataclass
class _LogLeases:
    """The leases of one log, in a thread of its own while there are devices."""

    log: str
    config: Config
    times: LeaseTimes | None
    obstacle: Callable[[str], str | None]

    def __post_init__(self) -> None:
        # Only an appliance with logs loads the client of NATS.
        from holdfast.replication.leases.leases import Leases
        from holdfast.replication.leases.thread import LeaseThread
        from holdfast.replication.leases.times import LEASE_TIMES

        settings = self.config.logs[self.log]
        self.leases = Leases(
            f"holdfast-log-{self.log}-devices",
            settings.node,
            self,
            times=self.times or LEASE_TIMES,
            replicas=settings.replicas,
            about=lambda key: {"devices": self._devices.get(key, [])},
            withheld=self._withheld,
        )
        self._servers = nats_servers(settings)
        self._thread = LeaseThread(self.leases, self._connect, f"holdfast-leases-{self.log}")
        self._devices: dict[str, list[str]] = {}
        self._wanted_since: dict[str, float] = {}
        self._missing: set[tuple[str, str]] = set()
        self._state = _State.STOPPED

    def adopt(self, devices: dict[str, list[str]]) -> None:
        now = time.monotonic()
        self._wanted_since = {key: self._wanted_since.get(key, now) for key in devices}
        before, self._devices = self._devices, devices
        if self._state is _State.RUNNING:
            self._thread.want(devices)
            for key in set(before) - set(devices):
                self._thread.give_back_soon(key, _GIVE_BACK_TIMEOUT_S)
        elif self._state is _State.IDLE:
            self.start()

    def start(self) -> None:
        self._state = _State.RUNNING if self._devices else _State.IDLE
        if self._devices:
            self._thread.start()
            self._thread.want(self._devices)

    def stop(self) -> None:
        self._state = _State.STOPPED
        self._thread.stop(_GIVE_BACK_TIMEOUT_S)

    def heartbeat(self) -> ThreadHeartbeat | None:
        return self._thread.heartbeat

    def status(self) -> dict[str, dict[str, Any]]:
        found = {}
        for key, devices in dict(self._devices).items():
            holder, unheld = self.leases.holder(key), self._unheld(key)
            for device in devices:
                node, reason = (None, unheld) if holder is None else (holder.node, None)
                if holder is not None and not _has(holder, device):
                    node, reason = None, f"{node} has its address, and not this device"
                is_held = self.leases.is_held(key)
                found[device] = {"node": node, "polled_here": is_held, "reason": reason}
        return dict(sorted(found.items()))

    def unpolled(self) -> dict[str, str]:
        reasons = {key: self._unheld(key) for key in dict(self._devices)}
        return {
            device: reason
            for key, reason in reasons.items()
            if reason is not None
            for device in self._devices.get(key, ())
        }

    def _unheld(self, key: str) -> str | None:
        """Why nobody holds a lease; `None` if somebody does, or may take it soon."""
        seen = self.leases.seen.get(key)
        wanted = self._wanted_since.get(key, 0.0)
        # Nobody takes a lease of a new bucket before.
        since = max(wanted, self.leases.may_settle_at, 0.0 if seen is None else seen.seen)
        is_late = time.monotonic() - since > self.leases.times.unheld_s
        if not is_late or self.leases.holder(key) is not None:
            return None
        if (withheld := self._withheld()) is not None:
            return withheld
        if (reason := self.leases.reason) is not None:
            return f"leases can't be taken: {reason}"
        return "no node takes its lease"

    def taken(self, key: str) -> None:
        for device in self._devices.get(key, ()):
            log_lines.write(logging.INFO, "device_taken_over", device=device, log=self.log)

    def lost(self, key: str, reason: str) -> None:
        for device in self._devices.get(key, ()):
            log_lines.write(
                logging.WARNING, "device_given_up", device=device, log=self.log, reason=reason
            )

    def availability_changed(self, reason: str | None) -> None:
        if reason is None:
            log_lines.write(logging.INFO, "leases_available", log=self.log)
        else:
            log_lines.write(logging.WARNING, "leases_unavailable", log=self.log, reason=reason)

    def changed(self) -> None:
        """Notes devices that nobody polls: the holder of their address does not have them."""
        for key, devices in self._devices.items():
            holder = self.leases.holder(key)
            if holder is None:
                continue
            for device in devices:
                unknown = not _has(holder, device)
                if unknown and (device, holder.node) not in self._missing:
                    self._missing.add((device, holder.node))
                    fields = {"device": device, "log": self.log, "node": holder.node}
                    log_lines.write(logging.WARNING, "device_not_polled", **fields)

    def _withheld(self) -> str | None:
        """Why what this node polls does not reach the others, though it could renew its leases."""
        obstacle = self.obstacle(self.log)
        return None if obstacle is None else f"the log is not usable here: {obstacle}"

    async def _connect(self, connected: Callable[[Any], None]) -> None:
        from holdfast.net.nats.connection import NatsConnection, Ping

        await NatsConnection(self._servers, {}, connected, Ping(), name="holdfast leases").run()
