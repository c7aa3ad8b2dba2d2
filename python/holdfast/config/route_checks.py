"""Checks what is behind the unit ids of a rule: memories, and routes to devices and links."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.client.url import SerialTarget
from holdfast.config.lenient import mapping, parsed
from holdfast.config.listeners import RouteConfig
from holdfast.config.scalars import is_name
from holdfast.config.shared_connection_checks import target_of
from holdfast.config.unit_keys import parse_unit_key, unit_ids
from holdfast.config.words import show
from holdfast.protocol import MAX_SERIAL_UNIT, MAX_UNIT
from holdfast.runtime.text import guess, listing

if TYPE_CHECKING:
    from holdfast.client.url import Target
    from holdfast.config.grant_checks import GrantChecks
    from holdfast.config.model import Config
    from holdfast.config.report import Report
    from holdfast.config.source import Key, KeyPath


@dataclass
class RouteChecks:
    """Checks routes, on data that is not validated."""

    report: Report
    grants: GrantChecks
    devices: dict[Any, Any]
    links: dict[Any, Any]

    def check_names(self) -> None:
        """Reports names that a device and a link have: a route could mean either."""
        for name in self.links:
            if name in self.devices:
                line = self.report.line(("devices", name))
                message = f"found the name of the device in line {line}, allowed: a different name"
                self.report.add(("links", name), message, of_key=True)

    def units(self, path: KeyPath, units: object) -> None:
        """Checks the unit ids of a Modbus rule, and what is behind them."""
        taken: dict[int, Key] = {}
        for key, target in mapping(units).items():
            here = (*path, key)
            self._once(here, key, taken)
            if not isinstance(target, dict):
                self._memory(here, target)
            elif "memory" in target:
                self._memory((*here, "memory"), target["memory"])
            else:
                self._route(here, key, target.get("route"))

    def _memory(self, path: KeyPath, name: object) -> None:
        if self._is_known(name) and name not in self.grants.names:
            kind = "device" if name in self.devices else "link"
            message = f"found {show(name)}, the name of a {kind}"
            self.report.add(path, f"{message}, allowed: a memory, or {{route: {name}}}")
        else:
            self.grants.memory(path, name)

    def _once(self, path: KeyPath, key: Key, taken: dict[int, Key]) -> None:
        """Reports a key that has unit ids of an earlier one."""
        valid = parse_unit_key(key, 0, MAX_UNIT)
        ids = () if valid is None else unit_ids(valid)
        twice = next((taken[unit] for unit in ids if unit in taken), None)
        if twice is not None:
            line = self.report.line((*path[:-1], twice))
            message = f"found {key}, which overlaps {twice} in line {line}"
            self.report.add(path, f"{message}, allowed: each unit id once", of_key=True)
        taken.update(dict.fromkeys(ids, key))

    def _route(self, path: KeyPath, key: Key, name: object) -> None:
        where = (*path, "route")
        if not is_name(name):
            return
        if name in self.devices:
            if mapping(self.devices[name]).get("enabled") is False:
                message = f"found {show(name)}, which is disabled, allowed: an enabled device"
                self.report.add(where, message)
            if isinstance(key, str) and parse_unit_key(key, 0, MAX_UNIT):
                message = f"found {key}, allowed with a route to a device: one unit id"
                self.report.add(path, f"{message}; a route to a link takes ranges", of_key=True)
        elif name in self.links:
            self._on_a_line(path, key, mapping(self.links[name]).get("url"))
        else:
            known = [each for each in (*self.devices, *self.links) if is_name(each)]
            allowed = f"{listing(known)}{guess(name, known)}" if known else "a device or a link"
            self.report.add(where, f"found {show(name)}, allowed: {allowed}")

    def _on_a_line(self, path: KeyPath, key: Key, url: object) -> None:
        """Reports unit ids that a serial line doesn't have."""
        valid = parse_unit_key(key, 0, MAX_UNIT)
        if valid is None or unit_ids(valid)[-1] <= MAX_SERIAL_UNIT:
            return
        if isinstance(parsed(target_of, url), SerialTarget):
            allowed = f"a unit id from 0 to {MAX_SERIAL_UNIT}"
            message = f"found {key}, allowed with a route to a serial line: {allowed}"
            self.report.add(path, message, of_key=True)

    def _is_known(self, name: object) -> bool:
        return is_name(name) and (name in self.devices or name in self.links)


def has_route(units: object) -> bool:
    """Whether a rule has a route, from data that is not validated."""
    return any(
        isinstance(target, dict) and "memory" not in target for target in mapping(units).values()
    )


def routed(config: Config) -> dict[str, None]:
    """The names of all routes of listeners, each once."""
    return {
        target.route: None
        for listener in config.listeners.values()
        for rule in listener.rules
        for target in rule.units.values()
        if isinstance(target, RouteConfig)
    }


def doubt_routes(config: Config, report: Report) -> None:
    """Warns about devices and links that nothing uses."""
    named = routed(config)
    for name, device in config.devices.items():
        if not device.has_readings and name not in named:
            message = "has no effect: the device has no reads and no tags, and no route names it"
            report.doubt(("devices", name), message)
    used = {_address(device.target) for device in config.devices.values()}
    for name, link in config.links.items():
        if name not in named and _address(link.target) not in used:
            report.doubt(("links", name), "has no effect: no route names the link")


def _address(target: Target) -> tuple[object, ...]:
    if isinstance(target, SerialTarget):
        return (os.path.realpath(target.device),)
    return (target.transport, target.host, target.port)
