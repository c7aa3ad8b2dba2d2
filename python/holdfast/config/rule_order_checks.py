"""Warns about rules, and units of rules, that earlier rules decide.

For each unit id, the first rule that names the peer and the unit decides. A raw ingest rule decides
for its senders as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.config.ip_addresses import parse_source
from holdfast.config.lenient import entries, mapping, parsed
from holdfast.config.listeners import SERIAL_TYPES
from holdfast.config.unit_keys import parse_unit_key, unit_ids
from holdfast.net.addresses import Network, covers
from holdfast.protocol import MAX_UNIT

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config.report import Report
    from holdfast.config.source import Key, KeyPath

_EVERY_UNIT = range(1)
"""Stands for all units of a rule that decides as a whole."""

_LINE = (parse_source("0.0.0.0/0"),)
"""Stands for the client of a serial line, which has no address."""


@dataclass
class _Holder:
    """The peers that a rule matches, and the unit ids that it names, by their keys."""

    path: KeyPath
    networks: Sequence[Network]
    is_known: bool
    """Whether all its sources are valid."""
    roles: list[Any] | None
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


def doubt_order(
    rules: Iterable[tuple[KeyPath, dict[Any, Any]]], kind: object, report: Report
) -> None:
    """Warns about what never matches in the rules of a listener of this kind, not validated."""
    earlier: list[_Holder] = []
    for path, rule in rules:
        holder = _holder(path, rule, kind)
        if holder.networks and holder.is_known:
            _doubt(holder, earlier, kind, report)
        earlier.append(holder)


def _holder(path: KeyPath, rule: dict[Any, Any], kind: object) -> _Holder:
    units: dict[Key | None, range] = {}
    for key in mapping(rule.get("units")):
        valid = parse_unit_key(key, 0, MAX_UNIT)
        units[key] = range(0) if valid is None else unit_ids(valid)
    if kind == "raw-ingest":
        units = {None: _EVERY_UNIT}
    if kind in SERIAL_TYPES:
        return _Holder(path, _LINE, True, None, units)
    written = entries(rule.get("sources"))
    sources = [parsed(parse_source, text) for text in written]
    known = [source for source in sources if source is not None]
    roles = entries(rule["roles"]) if "roles" in rule else None
    return _Holder(path, known, len(known) == len(written), roles, units)


def _doubt(rule: _Holder, earlier: list[_Holder], kind: object, report: Report) -> None:
    decided: dict[Key | None, list[_Holder]] = {}
    for key, units in rule.units.items():
        deciding = [_deciding(rule, unit, earlier) for unit in units]
        if deciding and all(deciding):
            decided[key] = [each for each in earlier if any(each in one for one in deciding)]
    if decided and len(decided) == len(rule.units):
        covering = [each for each in earlier if any(each in one for one in decided.values())]
        names = _names(covering, report)
        message = f"never matches: {_covered(rule, kind)} are covered by {names}"
        report.doubt(rule.path, message)
        return
    for key, holders in decided.items():
        assert key is not None, "a rule without unit ids is decided as a whole"
        verb = "decides" if len(holders) == 1 else "decide"
        noun = "unit" if len(rule.units[key]) == 1 else "units"
        message = f"never matches: {_names(holders, report)} {verb} for {noun} {key}"
        report.doubt((*rule.path, "units", key), message)


def _deciding(rule: _Holder, unit: int, earlier: list[_Holder]) -> list[_Holder]:
    """The earlier rules that decide for a unit and all peers of a rule; empty if a peer is left."""
    naming = [each for each in earlier if each.names(unit)]
    found: list[_Holder] = []
    for role in rule.roles or [None]:
        before = [each for each in naming if each.roles is None or role in each.roles]
        networks = [network for each in before for network in each.networks]
        if not all(covers(networks, source) for source in rule.networks):
            return []
        found += [each for each in before if each.overlaps(rule)]
    return found


def _covered(rule: _Holder, kind: object) -> str:
    if kind == "raw-ingest":
        return "all its sources" if rule.roles is None else "its sources and roles"
    if kind in SERIAL_TYPES:
        return "all its units"
    return "all its sources and units" if rule.roles is None else "its sources, roles and units"


def _names(rules: Iterable[_Holder], report: Report) -> str:
    return " and ".join(
        f"rules[{each.path[-1]}] in line {report.line(each.path)}" for each in rules
    )
