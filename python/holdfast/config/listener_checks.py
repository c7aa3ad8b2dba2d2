"""Checks rules between keys of listeners: limits, rules and memories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.config.allowed import allowed
from holdfast.config.connection_checks import doubt_source_limit
from holdfast.config.lenient import entries, mapping
from holdfast.config.listeners import SERIAL_TYPES, ModbusTcpListener
from holdfast.config.route_checks import has_route
from holdfast.config.rule_order_checks import doubt_order
from holdfast.config.tls_checks import check_server_tls
from holdfast.config.unique import refuse_repeats
from holdfast.config.unit_checks import RightsCheck, UnitCheck
from holdfast.config.words import show

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.grant_checks import GrantChecks
    from holdfast.config.report import Report
    from holdfast.config.route_checks import RouteChecks
    from holdfast.config.source import KeyPath

_DEFAULT_CONNECTIONS = ModbusTcpListener.model_fields["max_connections"].default
_OTHER = {"v1": "crc", "crc": "v1"}
_NAMING = {"v1": "units", "crc": "memories"}
"""The key with which a raw ingest rule names memories, by packet format."""
_REMOVED = ("max_requests_per_source", "max_writes_per_source")
"""Former keys of listeners, whose null was what always holds now."""
_RELAXED = {"packets": "many", "after_refusal": "continue", "crc": "none", "flags": "ignore"}
"""What relaxes the raw ingest protocol, with the only value of each key. They were keys of the
listener itself before."""


@dataclass
class ListenerChecks:
    """Checks the listeners of one file; files are relative to `folder`."""

    folder: Path
    report: Report
    grants: GrantChecks
    routes: RouteChecks
    memories: dict[Any, Any]
    """The memories, as in the file and not validated."""

    def check(self, listeners: object) -> None:
        """Reports what is wrong."""
        for name, listener in mapping(listeners).items():
            path: KeyPath = ("listeners", name)
            if self.report.is_settled(path) or not isinstance(listener, dict):
                continue
            kind = listener.get("type")
            self._limits(path, listener)
            if kind == "raw-ingest":
                self._raw(path, listener)
                self._secure_raw(path, listener)
            if kind == "modbus-tcp" and isinstance(listener.get("raw_ingest"), dict):
                self._shared_port((*path, "raw_ingest"), listener["raw_ingest"])
            if kind == "modbus-tls" or (kind == "raw-ingest" and "tls" in listener):
                tls = mapping(listener.get("tls"))
                check_server_tls((*path, "tls"), tls, self.folder, self.report)
            for rule_path, rule in self._rules(path, listener):
                if kind == "raw-ingest":
                    self._raw_rule(rule_path, rule, listener.get("format", "v1"))
                else:
                    self._rule(rule_path, rule)
            if kind in SERIAL_TYPES:
                self._line(path, listener)
            doubt_order(self._rules(path, listener), kind, self.report)

    def _rules(
        self, path: KeyPath, listener: dict[Any, Any]
    ) -> list[tuple[KeyPath, dict[Any, Any]]]:
        return [
            ((*path, "rules", index), rule)
            for index, rule in enumerate(entries(listener.get("rules")))
            if isinstance(rule, dict)
        ]

    def _limits(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        doubt_source_limit(path, listener, _DEFAULT_CONNECTIONS, self.report)
        for key in _REMOVED:
            if key not in listener:
                continue
            why = "an address waits only while others do: delete the key"
            if listener[key] is None:
                self.report.doubt((*path, key), f"has no effect: {why}")
                del listener[key]
            else:
                message = f"removed, there is no limit per second: {why}"
                self.report.settle((*path, key), message, of_key=True)

    def _rule(self, path: KeyPath, rule: dict[Any, Any]) -> None:
        units = rule.get("units")
        self.routes.units((*path, "units"), units)
        RightsCheck(path, rule, rule.get("access"), has_route(units), self.report).check()
        refuse_repeats((*path, "roles"), entries(rule.get("roles")), self.report)
        for key, unit in mapping(units).items():
            if isinstance(unit, dict):
                UnitCheck((*path, "units", key), unit, rule, self.memories, self.report).check()

    def _line(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        for rule_path, rule in self._rules(path, listener):
            if "sources" in rule:
                known = "allowed: units, access, functions, deny"
                message = f"not allowed on a serial line, {known}"
                self.report.settle((*rule_path, "sources"), message, of_key=True)

    def _shared_port(self, path: KeyPath, part: dict[Any, Any]) -> None:
        """Checks raw ingest packets on the port of a Modbus listener."""
        self._raw(path, part)
        for rule_path, rule in self._rules(path, part):
            self._raw_rule(rule_path, rule, part.get("format", "v1"))
        doubt_order(self._rules(path, part), "raw-ingest", self.report)

    def _raw(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        for key, relaxed in _RELAXED.items():
            if key in listener:
                message = f"moved, {_place(key, relaxed, listener[key])}"
                self.report.settle((*path, key), message, of_key=True)
        compat, path = mapping(listener.get("compat")), (*path, "compat")
        for key in ("crc", "flags"):
            if key in compat and listener.get("format", "v1") == "v1":
                message = "found with format v1, allowed: only with format crc"
                self.report.settle((*path, key), message, of_key=True)
        if "after_refusal" in compat and "packets" not in compat:
            message = "found without packets: many, allowed: only with it"
            self.report.settle((*path, "after_refusal"), message, of_key=True)

    def _secure_raw(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        """Checks keys of a raw ingest listener that belong to TLS."""
        places = [(path, listener, "max_handshakes")]
        places += [(where, rule, "roles") for where, rule in self._rules(path, listener)]
        for where, of, key in places:
            if key in of and "tls" not in listener:
                message = "found without tls, allowed: only with it"
                self.report.add((*where, key), message, of_key=True)
        for where, rule in self._rules(path, listener):
            refuse_repeats((*where, "roles"), entries(rule.get("roles")), self.report)

    def _raw_rule(self, path: KeyPath, rule: dict[Any, Any], form: object) -> None:
        for unit, target in mapping(rule.get("units")).items():
            if isinstance(target, dict):
                message = "found a route, allowed: a memory; a route takes Modbus requests only"
                if "memory" in target:
                    message = "found a mapping, allowed: a memory; areas limit a raw ingest rule"
                self.report.settle((*path, "units", unit), message)
            else:
                self.grants.memory((*path, "units", unit), target)
        self.grants.grant(path, rule)
        if form not in ("v1", "crc"):
            return
        needed, other = _NAMING[form], _NAMING[_OTHER[form]]
        if needed not in rule:
            words = allowed((*path, needed), self.report.document.data)
            message = f"missing with format {form}, allowed: {words}"
            self.report.add((*path, needed), message, of_key=True)
        if other in rule:
            message = f"found with format {form}, allowed: {needed}"
            self.report.add((*path, other), message, of_key=True)
        if form == "crc":
            self._have_ids((*path, "memories"), entries(rule.get("memories")))

    def _have_ids(self, path: KeyPath, names: list[Any]) -> None:
        for index, name in enumerate(names):
            memory = self.memories.get(name) if isinstance(name, str) else None
            if isinstance(memory, dict) and "id" not in memory:
                message = f"found {show(name)}, which has no id, allowed: a memory with an id"
                self.report.add((*path, index), message)


def _place(key: str, relaxed: str, found: object) -> str:
    """What to write in place of a former key of a listener."""
    where = f"compat: {{{key}: {relaxed}}}"
    if found == relaxed:
        return f"allowed: {where}"
    if (key, found) == ("crc", "if-present"):
        return f"allowed: no key, if all senders send a CRC, otherwise {where}"
    return f"allowed: no key for the strict protocol, otherwise {where}"
