"""The native poller: polled devices, the links of listeners, and the values of tags."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from holdfast import _core
from holdfast.appliance.parts import native_devices, native_links
from holdfast.appliance.parts.device_events import DeviceEvents
from holdfast.appliance.parts.part import Part
from holdfast.config.checks.units import routed
from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from holdfast.appliance.parts.audit import AuditLog
    from holdfast.appliance.parts.device_leases import DeviceLeases
    from holdfast.appliance.parts.mirrors import Mirrors
    from holdfast.appliance.parts.part import Plan
    from holdfast.appliance.parts.tag_values import TagValues
    from holdfast.appliance.parts.tag_writes import TagWrites
    from holdfast.config import Config
    from holdfast.polling import Reading
    from holdfast.types import ThreadHeartbeat

_END_TIMEOUT_S = 5.0
"""How long to wait for a thread that ends with the poller."""


class Devices(Part):
    """Everything that uses the native poller, which is created when needed."""

    def __init__(
        self, config: Config, audit: AuditLog, leases: DeviceLeases, mirrors: Mirrors
    ) -> None:
        super().__init__(config)
        self._audit, self._leases, self._mirrors = audit, leases, mirrors
        self.poller: _core.Poller | None = None
        self.values: TagValues | None = None
        """The values of tags. `None` until there are tags, as is `writes`."""
        self.writes: TagWrites | None = None
        self.passages: dict[str, _core.Passage] = {}
        """How services write to memories whose writes go to devices."""
        self._links: Mapping[str, _core.Link] = {}
        self._withdrawals: Mapping[str, _core.Withdrawal] = {}
        self._polled: set[str] = set()
        self._events = DeviceEvents()

    def open(self, plan: Plan) -> None:
        """Creates links and devices. They are polled only once all parts are open."""
        self._show_disabled(plan)
        self._begin = self._prepare(plan)

    def start(self) -> None:
        """Begins to poll."""
        self._begin()
        del self._begin  # It has links that a reload may remove.

    def prepare(self, plan: Plan) -> Callable[[], None]:
        """Creates links, and the devices with other settings."""
        replace = self._prepare(plan)

        def adopt() -> None:
            replace()
            # A poll of a device that was just disabled can't write its status block any more.
            self._show_disabled(plan)

        return adopt

    def _prepare(self, plan: Plan) -> Callable[[], None]:
        config = plan.config
        polled = {name for name, device in config.devices.items() if device.is_polled}
        poller, values, writes = self.poller, self.values, self.writes
        withdrawals = {
            name: withdrawal
            for name, withdrawal in self._withdrawals.items()
            if native_links.destination(config, name) == native_links.destination(self.config, name)
        }
        if poller is None and (polled or config.links or routed(config) or config.nats is not None):
            poller = _core.Poller([])
            plan.undo.callback(poller.stop)
        if poller is not None:
            if values is None and any(config.devices[name].has_tags for name in polled):
                from holdfast.appliance.parts.tag_values import TagValues
                from holdfast.appliance.parts.tag_writes import TagWrites

                values = TagValues(poller.new_receiver())
                writes = TagWrites(poller, self._audit.log, values.find)
            # The first use of an address decides the settings of its connection: links first.
            plan.links = native_links.links(config, plan.memories, poller, withdrawals)
        altered = [name for name in config.devices if f"devices.{name}" in plan.changed]
        tagged = {} if values is None else values.tagged(config, altered)
        results = None if values is None else values.results
        made = {
            name: native_devices.device(
                name, plan, results, tagged.get(name), self._leases.fence(name, config)
            )
            for name in altered
            if name in polled
        }

        def adopt() -> None:
            self.poller, self.values, self.writes = poller, values, writes
            for name in self._withdrawals.keys() - withdrawals.keys():
                self._withdrawals[name].withdraw()
            self._withdrawals = plan.links.withdrawals
            replaced = made.keys() & self._polled
            unread: set[str] = set()
            if values is not None:
                unread = values.adopt(config, tagged)
                values.start()
            self.passages.update(plan.links.passages)
            for name in self.passages.keys() - plan.links.passages.keys():
                del self.passages[name]
            plan.links.limit_waits(self._links)
            # With the names until now.
            self._log_links()
            self._links = plan.links.links
            gone = self._polled - polled
            if poller is not None:
                for name in gone:
                    poller.remove(name)
                for name, device in made.items():
                    if name in replaced:
                        poller.replace(name, device, at_once=name in unread)
                    else:
                        poller.add(device)
                # The gateway may hold some that are out of use, with settings that may come back.
                poller.forget_links(list(self._links.values()))
            self._polled = polled
            changed = {key.partition(".")[2] for key in plan.changed}
            refused = {link: on.counters()["refused_full"] for link, on in self._links.items()}
            self._events.replace(gone, made, self._links.keys() - changed, refused)

        return adopt

    def stop(self) -> None:
        """Offers outputs no more values, and refuses their writes."""
        if self.values is not None:
            self.values.stop()
        if self.writes is not None:
            self.writes.stop()

    def close(self) -> None:
        """Stops the poller, and with it the threads that take its results."""
        if self.writes is not None:
            self.writes.finish()
        if self.poller is not None:
            self.poller.stop()
        for thread in (self.values, self.writes):
            if thread is not None:
                thread.join(_END_TIMEOUT_S)

    def tick(self) -> None:
        """Logs changes of devices and links."""
        for name, counted in self._counters().items():
            self._events.log_device(name, counted, self.config.devices[name].forward)
        self._log_links()

    def _log_links(self) -> None:
        for name, link in self._links.items():
            counted = link.counters()
            self._events.log_link(name, counted, link.error)
            if name not in self.config.devices:
                self._events.log_strays("link", name, counted)

    def heartbeats(self) -> list[ThreadHeartbeat]:
        """The heartbeats of the poller and of the thread that takes values."""
        found = [] if self.poller is None else [self.poller.heartbeat]
        if self.values is not None and (tags := self.values.heartbeat()) is not None:
            found.append(tags)
        return found

    def stats(self) -> Mapping[str, Any]:
        """The health and the counters of each device, the counters of each link."""
        disabled = [name for name, device in self.config.devices.items() if not device.enabled]
        found = {**self._counters(), **{name: {"health": "disabled"} for name in disabled}}
        aging = self._mirrors.status()
        for name in found.keys() & aging.keys():
            found[name]["mirrors"] = aging[name]
        links = {
            name: {**link.counters(), "error": link.error} for name, link in self._links.items()
        }
        dropped = 0 if self.values is None else self.values.dropped
        return {"devices": found, "links": links, "tag_polls_dropped": dropped}

    def health(self) -> dict[str, str]:
        """The health of each polled device when `tick` looked last. Thread-safe."""
        return dict(self._events.health)

    def readings(self) -> list[tuple[Reading, float]]:
        """The last reading of each tag, and its age in seconds. Thread-safe."""
        return [] if self.values is None else self.values.latest_with_ages()

    def _counters(self) -> dict[str, dict[str, Any]]:
        """The counters of the devices in the configuration. Those of the scanner have a slash."""
        found = {} if self.poller is None else self.poller.counters()
        return {name: counted for name, counted in found.items() if "/" not in name}

    def _show_disabled(self, plan: Plan) -> None:
        """Writes the status blocks of disabled devices."""
        for name, device in plan.config.devices.items():
            if device.enabled or device.status is None:
                continue
            try:
                native_devices.show_disabled(name, device.status, plan.memories)
            except OSError as error:
                fields = {"device": name, "memory": device.status.memory, "error": str(error)}
                log_lines.write(logging.WARNING, "status_not_written", **fields)
