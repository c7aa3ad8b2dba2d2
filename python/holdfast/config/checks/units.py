"""Checks what is behind unit ids: memories, and routes to devices and links, with their rights."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeAlias

from holdfast.client.serial_settings import SerialTarget
from holdfast.config.checks.common import given, items, refuse_repeats, until_invalid
from holdfast.config.checks.memories import area_of, check_memory
from holdfast.config.models.base import INVALID
from holdfast.config.models.listeners import (
    RouteConfig,
    RuleConfig,
    SerialRuleConfig,
    UnitMemoryConfig,
)
from holdfast.config.text.messages import show
from holdfast.config.unit_rights import narrowed
from holdfast.config.values.unit_keys import parse_unit_key, unit_ids
from holdfast.protocol import (
    CODES,
    FILE_FUNCTIONS,
    GET_COMM_EVENT_LOG,
    MAX_CODE,
    MAX_UNIT,
    READ_EXCEPTION_STATUS,
    READ_FIFO_QUEUE,
    WRITING_CODES,
)
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import either, extent, listing
from holdfast.types import AREAS, WRITABLE_AREAS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.client.url import Target as DeviceTarget
    from holdfast.config.checks.common import Scope
    from holdfast.config.models.devices import RangeConfig
    from holdfast.config.models.listeners import ExceptionStatusConfig, Target
    from holdfast.config.models.root import Config
    from holdfast.config.text.yaml_document import Key, KeyPath
    from holdfast.config.values.unit_keys import UnitKey
    from holdfast.types import Access

    Rule: TypeAlias = RuleConfig | SerialRuleConfig
    Unit: TypeAlias = UnitMemoryConfig | RouteConfig


def check_rights(scope: Scope, path: KeyPath, rights: Rule | Unit, *, routed: bool) -> None:
    """Checks `functions` and `deny` of a rule, or of one of its units.

    If requests can go to devices (`routed`), there are more functions.
    """
    known = range(1, MAX_CODE + 1) if routed else CODES
    words = f"a function code from 1 to {MAX_CODE}" if routed else either(CODES)
    for key in given(rights, "functions", "deny"):
        with until_invalid():
            where, codes = (*path, key), getattr(rights, key)
            for index, code in enumerate(codes):
                if code not in known:
                    found = scope.report.raw((*where, index))
                    scope.report.add_final(
                        (*where, index), f"found {show(found)}, allowed: {words}"
                    )
            refuse_repeats(where, codes, scope.report)
    if len(given(rights, "functions", "deny")) > 1:
        message = "found together with functions, allowed: only one of them"
        scope.report.add_key((*path, "deny"), message)


def warn_of_rights(scope: Scope, path: KeyPath, rights: Rule | Unit, access: Access) -> None:
    """Warns about functions that write, of peers that only read."""
    if access == "read-write":
        return
    for index, code in enumerate(rights.functions or ()):
        where = (*path, "functions", index)
        if code in WRITING_CODES:
            message = f"function {code} has no effect: it writes, and access is read-only"
            scope.report.warn(where, message)
        elif code not in CODES:
            message = f"function {code} has no effect: it may write, and access is read-only"
            scope.report.warn(where, message)


def check_unit(scope: Scope, path: KeyPath, unit: Unit, rule: Rule) -> None:
    """Checks a unit with rights of its own."""
    check_rights(scope, path, unit, routed=isinstance(unit, RouteConfig))
    with until_invalid():
        if (rule.access, unit.access) == ("read-only", "read-write"):
            message = "found read-write, allowed: read-only, the access of the rule"
            scope.report.add((*path, "access"), message)
    with until_invalid():
        _check_functions(scope, (*path, "functions"), unit, rule)
    if isinstance(unit, UnitMemoryConfig):
        with until_invalid():
            _check_ranges(scope, (*path, "read"), unit, unit.read, AREAS)
        with until_invalid():
            _check_ranges(scope, (*path, "write"), unit, unit.write, WRITABLE_AREAS)
        with until_invalid():
            _check_exception_status(scope, (*path, "exception_status"), unit)


def _check_functions(scope: Scope, path: KeyPath, unit: Unit, rule: Rule) -> None:
    """Reports functions that the rule does not allow."""
    for where, code in items(path, unit.functions or ()):
        if code in (rule.deny or ()):
            message = f"found {code}, which the rule denies"
            scope.report.add(where, f"{message}, allowed: functions that the rule allows")
        elif rule.functions is not None and code not in rule.functions:
            allowed = listing([each for each in rule.functions if each is not INVALID])
            scope.report.add(where, f"found {code}, allowed: {allowed}, the functions of the rule")


def _check_ranges(
    scope: Scope,
    path: KeyPath,
    unit: UnitMemoryConfig,
    ranges: Sequence[RangeConfig] | None,
    areas: tuple[str, ...],
) -> None:
    for where, each in items(path, ranges or ()):
        with until_invalid():
            if each.area not in areas:
                message = f"found {each.area}, which Modbus clients can't write"
                scope.report.add((*where, "area"), f"{message}, allowed: {either(areas)}")
                continue
            _check_addresses(scope, (*where, "start"), unit.memory, each)


def _check_addresses(
    scope: Scope, path: KeyPath, memory: str, each: RangeConfig | ExceptionStatusConfig
) -> None:
    there, span = area_of(scope, path[:-1], memory, each.area), each.addresses
    if there is not None and (span[0] not in there or span[-1] not in there):
        allowed = f"allowed in {each.area} of {memory}: {extent(there)}"
        scope.report.add(path, f"found {extent(span)}, {allowed}")


def _check_exception_status(scope: Scope, path: KeyPath, unit: UnitMemoryConfig) -> None:
    bits = unit.exception_status
    if bits is None:
        return
    _check_addresses(scope, (*path, "address"), unit.memory, bits)
    readable = {
        address for each in unit.read or () if each.area == bits.area for address in each.addresses
    }
    if unit.read is not None and not readable.issuperset(bits.addresses):
        message = f"found {bits.area} {extent(bits.addresses)}, which read does not list"
        scope.report.add(path, f"{message}, allowed: bits that may be read")


def warn_of_unit(scope: Scope, path: KeyPath, unit: Unit, rule: Rule) -> None:
    """Warns about settings of a valid unit that have no effect."""
    access = unit.access or rule.access
    warn_of_rights(scope, path, unit, access)
    for index, code in enumerate(unit.deny or ()):
        named = rule.functions is None or code in rule.functions
        if code in (rule.deny or ()) or not named:
            message = f"{code} has no effect: the rule does not allow it either"
            scope.report.warn((*path, "deny", index), message)
    if not isinstance(unit, UnitMemoryConfig):
        return
    if access == "read-only" and unit.write:
        scope.report.warn((*path, "write"), "has no effect: access is read-only")
    functions, deny = narrowed(rule.functions, rule.deny, unit.functions, unit.deny)
    named = functions is None or READ_EXCEPTION_STATUS in functions
    if unit.exception_status and (not named or READ_EXCEPTION_STATUS in (deny or ())):
        message = f"has no effect: function {READ_EXCEPTION_STATUS} is not allowed"
        scope.report.warn((*path, "exception_status"), message)


def warn_of_missing(scope: Scope, path: KeyPath, rule: Rule, *, event_log: bool) -> None:
    """Warns about functions of a rule that memories have only with other settings."""
    units = rule.units.values()
    if any(isinstance(unit, RouteConfig) for unit in units):
        return
    missing = {} if event_log else {GET_COMM_EVENT_LOG: "the listener has no event_log"}
    if not any(isinstance(unit, UnitMemoryConfig) and unit.exception_status for unit in units):
        missing[READ_EXCEPTION_STATUS] = "no unit has an exception_status"
    memories = (unit for unit in units if not isinstance(unit, RouteConfig))
    names = {unit if isinstance(unit, str) else unit.memory for unit in memories}
    there = frozenset[int]().union(*(scope.config.memories[name].functions for name in names))
    missing |= dict.fromkeys(FILE_FUNCTIONS - there, "no memory of the rule has files")
    missing |= dict.fromkeys({READ_FIFO_QUEUE} - there, "no memory of the rule has fifo")
    for index, code in enumerate(rule.functions or ()):
        if code in missing:
            message = f"function {code} has no effect: {missing[code]}"
            scope.report.warn((*path, "functions", index), message)


def check_names(scope: Scope) -> None:
    """Reports names that a device and a link have: a route could mean either."""
    devices = scope.names("devices")
    for name in scope.names("links"):
        if name in devices:
            line = scope.report.line(("devices", name))
            message = f"found the name of the device in line {line}, allowed: a different name"
            scope.report.add_key(("links", name), message)


def check_units(scope: Scope, path: KeyPath, units: Mapping[UnitKey, Target]) -> None:
    """Checks the unit ids of a Modbus rule, and what is behind them."""
    taken: dict[int, Key] = {}
    for key, target in units.items():
        here = (*path, key)
        ids = range(0) if parse_unit_key(key, 0, MAX_UNIT) is None else unit_ids(key)
        _check_once(scope, here, ids, taken)
        with until_invalid():
            if isinstance(target, str):
                _check_memory(scope, here, target)
            elif isinstance(target, UnitMemoryConfig):
                _check_memory(scope, (*here, "memory"), target.memory)
            elif target is not INVALID:
                _check_route(scope, here, ids, target.route)


def _check_memory(scope: Scope, path: KeyPath, name: str) -> None:
    kind = "device" if name in scope.names("devices") else "link"
    if name in scope.names(f"{kind}s") and name not in scope.names("memories"):
        message = f"found {show(name)}, the name of a {kind}"
        scope.report.add(path, f"{message}, allowed: a memory, or {{route: {name}}}")
    else:
        check_memory(scope, path, name)


def _check_once(scope: Scope, path: KeyPath, ids: range, taken: dict[int, Key]) -> None:
    """Reports a key that has unit ids of an earlier one."""
    key = path[-1]
    twice = next((taken[unit] for unit in ids if unit in taken), None)
    if twice is not None:
        line = scope.report.line((*path[:-1], twice))
        message = f"found {key}, which overlaps {twice} in line {line}"
        scope.report.add_key(path, f"{message}, allowed: each unit id once")
    taken.update(dict.fromkeys(ids, key))


def _check_route(scope: Scope, path: KeyPath, ids: range, name: str) -> None:
    where, key = (*path, "route"), path[-1]
    devices, links = scope.names("devices"), scope.names("links")
    if name in devices:
        if ids and isinstance(key, str):
            message = f"found {key}, allowed with a route to a device: one unit id"
            scope.report.add_key(path, f"{message}; a route to a link takes ranges")
        if not scope.config.devices[name].enabled:
            message = f"found {show(name)}, which is disabled, allowed: an enabled device"
            scope.report.add(where, message)
    elif name not in links:
        known = [*devices, *links]
        allowed = f"{listing(known)}{suggestion(name, known)}" if known else "a device or a link"
        scope.report.add(where, f"found {show(name)}, allowed: {allowed}")


def routed(config: Config) -> dict[str, None]:
    """The names of all routes of listeners, each once."""
    return {
        target.route: None
        for listener in config.listeners.values()
        for rule in listener.rules
        for target in rule.units.values()
        if isinstance(target, RouteConfig)
    }


def warn_of_routes(scope: Scope) -> None:
    """Warns about devices and links that nothing uses."""
    config, report = scope.config, scope.report
    named = routed(config)
    for name, device in config.devices.items():
        if not device.has_readings and name not in named:
            message = "has no effect: the device has no reads and no tags, and no route names it"
            report.warn(("devices", name), message)
    used = {_address(device.target) for device in config.devices.values()}
    for name, link in config.links.items():
        if name not in named and _address(link.target) not in used:
            report.warn(("links", name), "has no effect: no route names the link")


def _address(target: DeviceTarget) -> tuple[object, ...]:
    if isinstance(target, SerialTarget):
        return (os.path.realpath(target.device),)
    return (target.transport, target.host, target.port)
