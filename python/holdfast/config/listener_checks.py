"""Checks rules between keys of listeners: limits, rules and memories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.config.allowed import allowed
from holdfast.config.ip_addresses import parse_source
from holdfast.config.lenient import entries, integer, mapping, parsed
from holdfast.config.listeners import SERIAL_TYPES, ModbusTcpListener
from holdfast.config.route_checks import has_route
from holdfast.config.scalars import MAX_CONNECTIONS
from holdfast.config.tls_checks import check_server_tls
from holdfast.config.unique import refuse_repeats
from holdfast.config.words import choice, show
from holdfast.net.addresses import Network, covers
from holdfast.protocol import CODES, MAX_CODE, OTHER_READS, WRITING_CODES

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


@dataclass
class _Holder:
    """The peers that a rule matches."""

    path: KeyPath
    networks: list[Network]
    roles: list[Any] | None
    """`None` for any role."""

    def overlaps(self, other: _Holder) -> bool:
        """Whether both rules have a source in common."""
        mine, theirs = self.networks, other.networks
        return any(covers(mine, network) for network in theirs) or any(
            covers(theirs, network) for network in mine
        )


@dataclass
class ListenerChecks:
    """Checks the listeners of one file; files are relative to `folder`."""

    folder: Path
    report: Report
    grants: GrantChecks
    routes: RouteChecks
    ids: dict[Any, Any]
    """The memories, as in the file and not validated, for their ids."""

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
            if kind == "modbus-tls":
                tls = mapping(listener.get("tls"))
                check_server_tls((*path, "tls"), tls, self.folder, self.report)
            for rule_path, rule in self._rules(path, listener):
                if kind == "raw-ingest":
                    self._raw_rule(rule_path, rule, listener.get("format", "v1"))
                else:
                    RuleCheck(rule_path, rule, self.report, self.routes).check()
            if kind in SERIAL_TYPES:
                self._line(path, listener)
            else:
                self._shadows(path, listener)

    def _rules(
        self, path: KeyPath, listener: dict[Any, Any]
    ) -> list[tuple[KeyPath, dict[Any, Any]]]:
        return [
            ((*path, "rules", index), rule)
            for index, rule in enumerate(entries(listener.get("rules")))
            if isinstance(rule, dict)
        ]

    def _limits(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        most = integer(listener.get("max_connections", _DEFAULT_CONNECTIONS), 1, MAX_CONNECTIONS)
        of_source = integer(listener.get("max_connections_per_source"), 1, MAX_CONNECTIONS)
        if most is not None and of_source is not None and of_source > most:
            message = f"{of_source} has no effect: max_connections is {most}"
            self.report.doubt((*path, "max_connections_per_source"), message)

    def _line(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        for rule_path, rule in self._rules(path, listener):
            if "sources" in rule:
                known = "allowed: units, access, functions, deny"
                message = f"not allowed on a serial line, {known}"
                self.report.settle((*rule_path, "sources"), message, of_key=True)
            if rule_path[-1] != 0:
                first = f"rules[0] in line {self.report.line((*path, 'rules', 0))}"
                message = f"never matches: {first} matches the whole serial line"
                self.report.doubt(rule_path, message)

    def _shadows(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        earlier: list[_Holder] = []
        for here, rule in self._rules(path, listener):
            written = entries(rule.get("sources"))
            sources = [parsed(parse_source, text) for text in written]
            known = [source for source in sources if source is not None]
            roles = entries(rule["roles"]) if "roles" in rule else None
            holder = _Holder(here, known, roles)
            if known and len(known) == len(written):
                self._shadow(holder, earlier)
            earlier.append(holder)

    def _shadow(self, rule: _Holder, earlier: list[_Holder]) -> None:
        taking: dict[KeyPath, None] = {}
        for role in rule.roles or [None]:
            before = [each for each in earlier if each.roles is None or role in each.roles]
            networks = [network for each in before for network in each.networks]
            if not all(covers(networks, source) for source in rule.networks):
                return
            taking |= {each.path: None for each in before if each.overlaps(rule)}
        names = [f"rules[{path[-1]}] in line {self.report.line(path)}" for path in taking]
        what = "all its sources" if rule.roles is None else "its sources and roles"
        self.report.doubt(rule.path, f"never matches: {what} are covered by {' and '.join(names)}")

    def _raw(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        if "crc" in listener and listener.get("format", "v1") == "v1":
            message = "found with format v1, allowed: only with format crc"
            self.report.add((*path, "crc"), message, of_key=True)

    def _raw_rule(self, path: KeyPath, rule: dict[Any, Any], form: object) -> None:
        for unit, target in mapping(rule.get("units")).items():
            if isinstance(target, dict):
                message = "found a route, allowed: a memory; a route takes Modbus requests only"
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
            memory = self.ids.get(name) if isinstance(name, str) else None
            if isinstance(memory, dict) and "id" not in memory:
                message = f"found {show(name)}, which has no id, allowed: a memory with an id"
                self.report.add((*path, index), message)


@dataclass
class RuleCheck:
    """Checks one rule of a Modbus listener."""

    path: KeyPath
    rule: dict[Any, Any]
    report: Report
    routes: RouteChecks

    def check(self) -> None:
        """Reports what is wrong."""
        units = self.rule.get("units")
        self.routes.units((*self.path, "units"), units)
        for key in ("functions", "deny"):
            self._codes((*self.path, key), entries(self.rule.get(key)), routed=has_route(units))
        for key in ("functions", "deny", "roles"):
            refuse_repeats((*self.path, key), entries(self.rule.get(key)), self.report)
        if "functions" in self.rule and "deny" in self.rule:
            message = "found together with functions, allowed: only one of them"
            self.report.add((*self.path, "deny"), message, of_key=True)
        if self.rule.get("access") == "read-only":
            self._writes()

    def _codes(self, path: KeyPath, codes: list[Any], *, routed: bool) -> None:
        """Reports function codes that no unit of the rule can have."""
        known = range(1, MAX_CODE + 1) if routed else CODES
        words = f"a function code from 1 to {MAX_CODE}" if routed else choice(CODES)
        for index, code in enumerate(codes):
            if type(code) is not int or code not in known:
                self.report.settle((*path, index), f"found {show(code)}, allowed: {words}")

    def _writes(self) -> None:
        for index, code in enumerate(entries(self.rule.get("functions"))):
            if integer(code, 0, 255) in WRITING_CODES:
                message = f"function {code} has no effect: it writes, and access is read-only"
                self.report.doubt((*self.path, "functions", index), message)
            elif integer(code, 1, MAX_CODE) and code not in (*CODES, *OTHER_READS):
                message = f"function {code} has no effect: it may write, and access is read-only"
                self.report.doubt((*self.path, "functions", index), message)
