"""Warns about rules of a listener, and their units, that never match.

For each unit id, the first rule that names the peer and the unit decides. A raw ingest rule decides
for its senders as a whole. So what earlier rules decide for all peers has no effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from holdfast.config.models.listeners import (
    RawRuleConfig,
    RuleConfig,
    SecureRawRuleConfig,
    SerialRuleConfig,
    TlsRuleConfig,
)
from holdfast.config.values.ip_addresses import parse_source
from holdfast.config.values.unit_keys import unit_ids
from holdfast.net.addresses import Network, covers

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import Key, KeyPath

    AnyRule: TypeAlias = RuleConfig | SerialRuleConfig | RawRuleConfig


_EVERY_UNIT = range(1)
"""Stands for all units of a rule that decides as a whole."""

_LINE = (parse_source("0.0.0.0/0"),)
"""Stands for the client of a serial line, which has no address."""


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
