"""Exact sets of addresses: allowed networks without denied networks.

Both families share one number line, with IPv4 after IPv6. A set is a list of intervals on it. An
IPv4-mapped IPv6 address counts as its IPv4 address: no other peer ever has it.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network
from typing import TYPE_CHECKING, TypeAlias

from holdfast.config.ip_addresses import SOURCE_FORM
from holdfast.config.words import show
from holdfast.net.addresses import MAPPED, Network, unmapped

if TYPE_CHECKING:
    from collections.abc import Iterable

Stretch: TypeAlias = tuple[int, int]

_FOUR = 1 << 129
EVERYBODY = (IPv4Network("0.0.0.0/0"), IPv6Network("::/0"))


@dataclass(frozen=True)
class Peers:
    """A set of IPv4 and IPv6 addresses; its stretches are sorted and never adjacent."""

    stretches: tuple[Stretch, ...]

    @classmethod
    def of(cls, networks: Iterable[Network]) -> Peers:
        """All addresses of some networks."""
        return cls(_joined(_stretch(network) for network in networks))

    def __bool__(self) -> bool:
        low, high = _stretch(MAPPED)
        return any(first < low or last > high for first, last in self.stretches)

    def __or__(self, other: Peers) -> Peers:
        return Peers(_joined((*self.stretches, *other.stretches)))

    def __and__(self, other: Peers) -> Peers:
        return self - (self - other)

    def __sub__(self, other: Peers) -> Peers:
        left: list[Stretch] = []
        cuts = iter((*other.stretches, (_FOUR * 2, _FOUR * 2)))
        cut = next(cuts)
        for first, last in self.stretches:
            while cut[1] < first:
                cut = next(cuts)
            while cut[0] <= last:
                if first < cut[0]:
                    left.append((first, cut[0] - 1))
                first = cut[1] + 1
                if first > last:
                    break
                cut = next(cuts)
            if first <= last:
                left.append((first, last))
        return Peers(tuple(left))

    def networks(self) -> list[Network]:
        """The smallest list of networks that equals this set, IPv4 first."""
        four: list[Network] = []
        six: list[Network] = []
        for first, last in self.stretches:
            if first >= _FOUR:
                ends = IPv4Address(first - _FOUR), IPv4Address(last - _FOUR)
                four += ipaddress.summarize_address_range(*ends)
            else:
                found = ipaddress.summarize_address_range(IPv6Address(first), IPv6Address(last))
                six += (network for network in found if not network.subnet_of(MAPPED))
        return [*four, *six]

    def written(self) -> list[str]:
        """The networks as text for a configuration."""
        return [written(network) for network in self.networks()]


def written(network: Network) -> str:
    """A network as text; a single address without its prefix length."""
    single = network.prefixlen == network.max_prefixlen
    return str(network.network_address) if single else str(network)


def parse_network(text: object) -> Network:
    """Parses a network or an address as the source does: ignores host bits, unmaps IPv4.

    Raises `ValueError` for anything else.
    """
    message = f"found {show(text)}, allowed: {SOURCE_FORM}"
    if not isinstance(text, str):
        raise ValueError(message)
    if not re.fullmatch(r"[0-9a-fA-F.:]+(/[0-9]{1,3})?", text.strip()):
        raise ValueError(message)
    try:
        network = ipaddress.ip_network(text.strip(), strict=False)
    except ValueError:
        raise ValueError(message) from None
    return unmapped(network)


def _stretch(network: Network) -> Stretch:
    base = _FOUR if isinstance(network, IPv4Network) else 0
    return base + int(network.network_address), base + int(network.broadcast_address)


def _joined(stretches: Iterable[Stretch]) -> tuple[Stretch, ...]:
    joined: list[Stretch] = []
    for first, last in sorted(stretches):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = joined[-1][0], max(joined[-1][1], last)
        else:
            joined.append((first, last))
    return tuple(joined)
