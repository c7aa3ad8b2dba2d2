"""Checks rules between keys of listeners: limits, rules and their order, and memories.

For each unit id, the first rule that names the peer and the unit decides. A raw ingest rule decides
for its senders as a whole. There are warnings about rules, and units, that earlier rules decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.config.allowed_words import allowed
from holdfast.config.checks.common import given, items, refuse_repeats, until_invalid
from holdfast.config.checks.memories import check_grant, check_memory
from holdfast.config.checks.tls import check_server_tls
from holdfast.config.checks.units import (
    check_names,
    check_rights,
    check_unit,
    check_units,
    warn_of_missing,
    warn_of_rights,
    warn_of_unit,
)
from holdfast.config.models.base import INVALID
from holdfast.config.models.connection_limits import ConnectionLimits
from holdfast.config.models.listeners import (
    ModbusTcpListener,
    RawIngestConfig,
    RawIngestListener,
    RawRuleConfig,
    RouteConfig,
    RuleConfig,
    SecureRawRuleConfig,
    SerialRuleConfig,
    TlsRuleConfig,
    tls_of,
)
from holdfast.config.text.messages import show
from holdfast.config.values.ip_addresses import parse_source
from holdfast.config.values.unit_keys import unit_ids
from holdfast.net.addresses import Network, covers

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.listeners import Listener, Target
    from holdfast.config.models.services import RestConfig
    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import Key, KeyPath
    from holdfast.config.values.unit_keys import UnitKey

    AnyRule: TypeAlias = RuleConfig | SerialRuleConfig | RawRuleConfig


_OTHER = {"v1": "crc", "crc": "v1"}
_NAMING = {"v1": "units", "crc": "memories"}
"""The key with which a raw ingest rule names memories, by packet format."""


_EVERY_UNIT = range(1)
"""Stands for all units of a rule that decides as a whole."""

_LINE = (parse_source("0.0.0.0/0"),)
"""Stands for the client of a serial line, which has no address."""


def check_listeners(scope: Scope) -> None:
    """Reports what is wrong."""
    check_names(scope)
    with until_invalid():
        for path, listener in items(("listeners",), scope.config.listeners):
            with until_invalid():
                if isinstance(listener, RawIngestListener):
                    _check_without_tls(scope, path, listener)
                    _check_raw(scope, path, listener)
                else:
                    _check_rules(scope, path, listener)
            with until_invalid():
                if isinstance(listener, ModbusTcpListener) and listener.raw_ingest is not None:
                    _check_raw(scope, (*path, "raw_ingest"), listener.raw_ingest)
            with until_invalid():
                tls = tls_of(listener)
                if tls is not None:
                    check_server_tls((*path, "tls"), tls, scope.report)


def warn_of_listeners(scope: Scope) -> None:
    """Warns about settings of valid listeners that have no effect."""
    for name, listener in scope.config.listeners.items():
        path: KeyPath = ("listeners", name)
        if isinstance(listener, ConnectionLimits):
            warn_of_source_limit(scope, path, listener)
        if isinstance(listener, ModbusTcpListener) and listener.raw_ingest is not None:
            packets = items((*path, "raw_ingest", "rules"), listener.raw_ingest.rules)
            warn_of_order(packets, scope.report)
        rules: Sequence[Any] = listener.rules
        for where, rule in items((*path, "rules"), rules):
            if not isinstance(listener, RawIngestListener):
                warn_of_rights(scope, where, rule, rule.access)
                warn_of_missing(scope, where, rule, event_log=listener.event_log)
                for each, unit in items((*where, "units"), rule.units):
                    if not isinstance(unit, str):
                        warn_of_unit(scope, each, unit, rule)
        warn_of_order(items((*path, "rules"), rules), scope.report)


def warn_of_source_limit(
    scope: Scope, path: KeyPath, settings: ConnectionLimits | RestConfig
) -> None:
    """Warns about a limit for one source that is above the limit for all."""
    most, of_source = settings.max_connections, settings.max_connections_per_source
    if of_source is not None and of_source > most:
        message = f"{of_source} has no effect: max_connections is {most}"
        scope.report.warn((*path, "max_connections_per_source"), message)


def _check_rules(scope: Scope, path: KeyPath, listener: Listener) -> None:
    rules: Sequence[Any] = listener.rules
    for where, rule in items((*path, "rules"), rules):
        units: dict[UnitKey, Target] = {}
        with until_invalid():
            units = rule.units
        check_units(scope, (*where, "units"), units)
        routed = any(isinstance(target, RouteConfig) for target in units.values())
        check_rights(scope, where, rule, routed=routed)
        with until_invalid():
            if isinstance(rule, TlsRuleConfig):
                refuse_repeats((*where, "roles"), rule.roles, scope.report)
        for each, unit in items((*where, "units"), units):
            if not isinstance(unit, str):
                check_unit(scope, each, unit, rule)


def _check_without_tls(scope: Scope, path: KeyPath, listener: RawIngestListener) -> None:
    """Reports keys of a raw ingest listener that belong to TLS."""
    if given(listener, "tls"):
        return
    places: list[tuple[KeyPath, str]] = []
    with until_invalid():
        for where, rule in items((*path, "rules"), listener.rules):
            places += [(where, key) for key in given(rule, "roles")]
    for where, key in places:
        scope.report.add_key((*where, key), "found without tls, allowed: only with it")


def _check_raw(scope: Scope, path: KeyPath, part: RawIngestListener | RawIngestConfig) -> None:
    with until_invalid():
        if part.compat is not None:
            for key in given(part.compat, "crc", "flags"):
                if part.format == "v1":
                    message = "found with format v1, allowed: only with format crc"
                    scope.report.add_final((*path, "compat", key), message, of_key=True)
            if given(part.compat, "after_refusal") and not given(part.compat, "packets"):
                message = "found without packets: many, allowed: only with it"
                scope.report.add_final((*path, "compat", "after_refusal"), message, of_key=True)
    rules: Sequence[RawRuleConfig] = part.rules
    for where, rule in items((*path, "rules"), rules):
        _check_raw_rule(scope, where, rule)
        with until_invalid():
            if isinstance(rule, SecureRawRuleConfig):
                refuse_repeats((*where, "roles"), rule.roles, scope.report)
        with until_invalid():
            _check_format(scope, where, rule, part.format)


def _check_raw_rule(scope: Scope, path: KeyPath, rule: RawRuleConfig) -> None:
    with until_invalid():
        for where, name in items((*path, "units"), rule.units):
            check_memory(scope, where, name)
    check_grant(scope, path, rule)


def _check_format(scope: Scope, path: KeyPath, rule: RawRuleConfig, form: str) -> None:
    """A rule names memories in the way of its packet format."""
    needed, other = _NAMING[form], _NAMING[_OTHER[form]]
    if not given(rule, needed):
        words = allowed((*path, needed), scope.report.document.data)
        scope.report.add_key((*path, needed), f"missing with format {form}, allowed: {words}")
    if given(rule, other):
        scope.report.add_key((*path, other), f"found with format {form}, allowed: {needed}")
    if form == "crc":
        for where, name in items((*path, "memories"), rule.memories):
            memory = scope.config.memories.get(name, INVALID)
            if memory is not INVALID and not given(memory, "id"):
                message = f"found {show(name)}, which has no id, allowed: a memory with an id"
                scope.report.add(where, message)


@dataclass
class _Holder:
    """The peers that a rule matches, and the unit ids that it names, by their keys."""

    path: KeyPath
    rule: AnyRule
    networks: Sequence[Network]
    roles: Sequence[str] | None
    """`None` for any role."""
    units: dict[Key | None, range]

    def names(self, unit: int) -> bool:
        """Whether the rule names the unit id."""
        return any(unit in units for units in self.units.values())

    def overlaps(self, other: _Holder) -> bool:
        """Whether both rules have a source in common."""
        mine, theirs = self.networks, other.networks
        return any(covers(mine, network) for network in theirs) or any(
            covers(theirs, network) for network in mine
        )


def warn_of_order(rules: Iterable[tuple[KeyPath, AnyRule]], report: Report) -> None:
    """Warns about what never matches in the rules of a valid listener."""
    earlier: list[_Holder] = []
    for path, rule in rules:
        holder = _holder(path, rule)
        _warn(holder, earlier, report)
        earlier.append(holder)


def _holder(path: KeyPath, rule: AnyRule) -> _Holder:
    if isinstance(rule, RawRuleConfig):
        units: dict[Key | None, range] = {None: _EVERY_UNIT}
    else:
        units = {key: unit_ids(key) for key in rule.units}
    sources = _LINE if isinstance(rule, SerialRuleConfig) else rule.sources
    roles = rule.roles if isinstance(rule, TlsRuleConfig | SecureRawRuleConfig) else None
    return _Holder(path, rule, sources, roles, units)


def _warn(rule: _Holder, earlier: list[_Holder], report: Report) -> None:
    decided: dict[Key | None, list[_Holder]] = {}
    # Most unit ids of a range are in the same rules.
    known: dict[tuple[int, ...], list[_Holder]] = {}

    def deciding_for(unit: int) -> list[_Holder]:
        naming = [each for each in earlier if each.names(unit)]
        which = tuple(map(id, naming))
        if which not in known:
            known[which] = _deciding(rule, naming)
        return known[which]

    for key, units in rule.units.items():
        deciding = [deciding_for(unit) for unit in units]
        if deciding and all(deciding):
            decided[key] = [each for each in earlier if any(each in one for one in deciding)]
    if decided and len(decided) == len(rule.units):
        covering = [each for each in earlier if any(each in one for one in decided.values())]
        names = _names(covering, report)
        report.warn(rule.path, f"never matches: {_covered(rule)} are covered by {names}")
        return
    for key, holders in decided.items():
        assert key is not None, "a rule without unit ids is decided as a whole"
        verb = "decides" if len(holders) == 1 else "decide"
        noun = "unit" if len(rule.units[key]) == 1 else "units"
        message = f"never matches: {_names(holders, report)} {verb} for {noun} {key}"
        report.warn((*rule.path, "units", key), message)


def _deciding(rule: _Holder, naming: list[_Holder]) -> list[_Holder]:
    """Those of the earlier rules with a unit that decide for all peers of a rule; empty if a peer
    is left.
    """
    found: list[_Holder] = []
    for role in rule.roles or (None,):
        before = [each for each in naming if each.roles is None or role in each.roles]
        networks = [network for each in before for network in each.networks]
        if not all(covers(networks, source) for source in rule.networks):
            return []
        found += [each for each in before if each.overlaps(rule)]
    return found


def _covered(rule: _Holder) -> str:
    if isinstance(rule.rule, RawRuleConfig):
        return "all its sources" if rule.roles is None else "its sources and roles"
    if isinstance(rule.rule, SerialRuleConfig):
        return "all its units"
    return "all its sources and units" if rule.roles is None else "its sources, roles and units"


def _names(rules: Iterable[_Holder], report: Report) -> str:
    return " and ".join(
        f"rules[{each.path[-1]}] in line {report.line(each.path)}" for each in rules
    )
