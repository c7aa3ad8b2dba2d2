"""Converts policies of single units to rules for all units of a listener.

The source has a list of rules for each unit. In Holdfast, the first rule that matches a peer
applies to every unit. Two networks are nested or disjoint, so each network without its nested
networks is a set of peers with equal rights. Nested networks come first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.config.words import listing
from holdfast.importing import functions
from holdfast.importing.peers import Peers, written

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.source import KeyPath
    from holdfast.importing.notes import Desk
    from holdfast.net.addresses import Network

MAX_SHOWN = 4


@dataclass(frozen=True)
class Policy:
    """The rules of one unit: the first rule whose networks contain the peer applies."""

    unit: int
    memory: str
    touching: frozenset[int]
    """The functions that access an area of the memory; others have no effect on it."""
    rules: tuple[tuple[tuple[Network, ...], frozenset[int]], ...]

    def functions(self, network: Network) -> frozenset[int]:
        """The functions of peers in a network, but not in a narrower network of any rule."""
        for networks, allowed in self.rules:
            if any(_inside(network, other) for other in networks):
                return allowed
        return frozenset()


Profile: TypeAlias = tuple[tuple[Policy, frozenset[int]], ...]
"""The functions of a group of peers by unit; only units with at least one effective function."""


@dataclass(frozen=True)
class RuleGrant:
    """What a rule allows to the peers that it matches."""

    units: tuple[int, ...]
    functions: frozenset[int]


@dataclass
class Merger:
    """Builds the rules of one listener."""

    desk: Desk
    path: KeyPath
    policies: list[Policy]
    _conflicts: dict[Profile, list[Network]] = field(default_factory=dict, init=False)

    def rules(self, admitted: Peers) -> list[dict[str, Any]]:
        """The rules in order, only for admitted peers."""
        grants = self._pruned(self._grants())
        for profile, networks in self._conflicts.items():
            self._tell(profile, networks)
        nobody = [network for network, grant in grants.items() if not grant.units]
        waiting = {network: grant for network, grant in grants.items() if grant.units}
        memories = {policy.unit: policy.memory for policy in self.policies}
        rules = []
        while waiting:
            grant, ready = _next(waiting)
            peers = Peers(())
            for network in ready:
                del waiting[network]
                cut = Peers.of(other for other in nobody if _inside(other, network))
                peers |= Peers.of([network]) - cut
            if peers := peers & admitted:
                units = {unit: memories[unit] for unit in grant.units}
                rights = functions.rights(grant.functions)
                rules.append({"sources": peers.written(), "units": units, **rights})
        return rules

    def _grants(self) -> dict[Network, RuleGrant]:
        """The grant of each network that is not fully covered by narrower networks."""
        networks = dict.fromkeys(
            network for policy in self.policies for rule in policy.rules for network in rule[0]
        )
        grants = {}
        for network in networks:
            narrower = (other for other in networks if _within(other, network))
            if not Peers.of([network]) - Peers.of(narrower):
                continue
            grants[network] = self._grant(self._profile(network), network)
        return grants

    def _profile(self, network: Network) -> Profile:
        found = ((policy, policy.functions(network)) for policy in self.policies)
        return tuple((policy, allowed) for policy, allowed in found if allowed & policy.touching)

    def _grant(self, profile: Profile, network: Network) -> RuleGrant:
        grant = _common(profile)
        if len(grant.units) < len(profile) or any(
            (allowed & policy.touching & functions.SOURCE) - grant.functions
            for policy, allowed in profile
        ):
            self._conflicts.setdefault(profile, []).append(network)
        return grant

    def _pruned(self, grants: dict[Network, RuleGrant]) -> dict[Network, RuleGrant]:
        """Drops networks with the same grant as the next wider network."""
        nothing = RuleGrant((), frozenset())
        kept: dict[Network, RuleGrant] = {}
        for network in sorted(grants, key=lambda network: network.prefixlen):
            wider = [other for other in kept if _within(network, other)]
            around = max(wider, key=lambda other: other.prefixlen, default=None)
            if grants[network] != (nothing if around is None else kept[around]):
                kept[network] = grants[network]
        return {network: kept[network] for network in grants if network in kept}

    def _tell(self, profile: Profile, networks: list[Network]) -> None:
        shown = [written(network) for network in networks[:MAX_SHOWN]]
        if len(networks) > MAX_SHOWN:
            shown.append(f"{len(networks) - MAX_SHOWN} more")
        had = "; ".join(
            f"unit {policy.unit}: {functions.spelled(allowed & policy.touching)}"
            for policy, allowed in profile
        )
        grant = _common(profile)
        touched = {code for policy, _ in profile for code in policy.touching}
        got = functions.spelled(grant.functions & touched)
        left = [str(policy.unit) for policy, _ in profile if policy.unit not in grant.units]
        gone = f", and unit {listing(left)} is not served to them" if left else ""
        message = (
            f"peers in {listing(shown)} had different functions ({had}); a rule allows the same"
            f" functions for all its units: {got}{gone}; to allow others, use a separate listener"
        )
        self.desk.note("changed", self.path, message)


def _common(profile: Profile) -> RuleGrant:
    """One set of functions for all units. It gives no unit a function that it did not have.

    Omits a unit that would have no function left, or would leave none to the units before it.
    """
    served: Profile = ()
    for entry in profile:
        more = (*served, entry)
        if all(_shared(more) & allowed & policy.touching for policy, allowed in more):
            served = more
    by_all = functions.ALL.intersection(*(allowed for _, allowed in served))
    by_one = frozenset[int]().union(*(allowed & policy.touching for policy, allowed in served))
    had = by_all | by_one if served else by_one
    return RuleGrant(tuple(policy.unit for policy, _ in served), had & _shared(served))


def _shared(profile: Profile) -> frozenset[int]:
    """The functions that every unit had, or that have no effect on its memory."""
    refused = ((policy.touching | functions.OTHERS) - allowed for policy, allowed in profile)
    return functions.ALL.difference(*refused)


def _next(waiting: dict[Network, RuleGrant]) -> tuple[RuleGrant, list[Network]]:
    """The grant for the next rule, with its networks that no narrower network must precede.

    Prefers a grant whose networks are all ready. Otherwise, takes only networks that a wider
    network waits for.
    """

    def ready(network: Network) -> bool:
        return not any(
            _within(other, network) and waiting[other] != waiting[network] for other in waiting
        )

    free = [network for network in waiting if ready(network)]
    grants = dict.fromkeys(waiting[network] for network in free)
    whole = [
        grant
        for grant in grants
        if all(network in free for network in waiting if waiting[network] == grant)
    ]
    if whole:
        return whole[0], [network for network in free if waiting[network] == whole[0]]
    urgent = [one for one in free if any(_within(one, other) for other in waiting)]
    grant = waiting[urgent[0]]
    return grant, [network for network in urgent if waiting[network] == grant]


def _inside(network: Network, other: Network) -> bool:
    """Whether all of `network` is in `other`."""
    return network.version == other.version and network.subnet_of(other)  # type: ignore[arg-type]


def _within(network: Network, other: Network) -> bool:
    return network != other and _inside(network, other)


def unserved(policies: Iterable[Policy], rules: Iterable[dict[str, Any]]) -> list[Policy]:
    """The policies whose unit no rule serves."""
    served = {unit for rule in rules for unit in rule["units"]}
    return [policy for policy in policies if policy.unit not in served]
