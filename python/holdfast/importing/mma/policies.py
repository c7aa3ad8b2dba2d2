"""Converts policies of single units to rules of a listener, without loss.

The source has a list of rules for each unit; the first one whose networks contain the peer applies.
So it is in Holdfast, for each unit id. A rule that allows nothing can't be written, so its peers
are cut out of later rules for that unit. Units with equal rules share them where their order allows
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.importing.mma import function_rights as functions
from holdfast.importing.mma.address_filters import Peers

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.net.addresses import Network


@dataclass(frozen=True)
class Policy:
    """The rules of one unit: the first rule whose networks contain the peer applies."""

    unit: int
    memory: str
    touching: frozenset[int]
    """The functions that access an area of the memory; others have no effect on it."""
    rules: tuple[tuple[tuple[Network, ...], frozenset[int]], ...]


@dataclass(frozen=True)
class UnitRule:
    """What some peers may do with one unit."""

    peers: Peers
    functions: frozenset[int]


def merged(policies: Sequence[Policy], admitted: Peers) -> list[dict[str, Any]]:
    """The rules of a listener in order, only for admitted peers."""
    memories = {policy.unit: policy.memory for policy in policies}
    waiting = {policy.unit: _unit_rules(policy, admitted) for policy in policies}
    rules = []
    while heads := {unit: left[0] for unit, left in waiting.items() if left}:
        chosen = next((head for head in heads.values() if not _comes_later(head, waiting)), None)
        chosen = next(iter(heads.values())) if chosen is None else chosen
        units = [unit for unit, head in heads.items() if head == chosen]
        for unit in units:
            waiting[unit].pop(0)
        rules.append(
            {
                "sources": chosen.peers.written(),
                "units": {unit: memories[unit] for unit in units},
                **functions.rights(chosen.functions),
            }
        )
    return rules


def _comes_later(rule: UnitRule, waiting: dict[int, list[UnitRule]]) -> bool:
    """Whether a unit has the rule after another one: it could share the rule later."""
    return any(rule in left[1:] for left in waiting.values())


def _unit_rules(policy: Policy, admitted: Peers) -> list[UnitRule]:
    """The rules of one unit that allow something to somebody."""
    found: list[UnitRule] = []
    undecided, refused = admitted, Peers(())
    for networks, allowed in policy.rules:
        peers = Peers.of(networks) & admitted
        decided = peers & undecided
        undecided -= peers
        if not decided:
            continue
        if not allowed & policy.touching:
            refused |= decided
            continue
        peers -= refused
        if found and found[-1].functions == allowed:
            peers |= found.pop().peers
        found.append(UnitRule(peers, allowed))
    return found


def unserved(policies: Iterable[Policy], rules: Iterable[dict[str, Any]]) -> list[Policy]:
    """The policies whose unit no rule serves."""
    served = {unit for rule in rules for unit in rule["units"]}
    return [policy for policy in policies if policy.unit not in served]
