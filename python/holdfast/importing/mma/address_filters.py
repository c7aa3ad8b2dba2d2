"""Sets of addresses: allowed networks without denied networks, from the filters of the source.

Both families share one number line, with IPv4 after IPv6. A set is a list of intervals on it. An
IPv4-mapped IPv6 address counts as its IPv4 address: no other peer ever has it.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network
from typing import TYPE_CHECKING, TypeAlias

from holdfast.config.text.messages import show
from holdfast.config.values.ip_addresses import SOURCE_FORM
from holdfast.net.addresses import MAPPED, Network, unmapped

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.importing.key_reader import Section
    from holdfast.net.addresses import Network


Stretch: TypeAlias = tuple[int, int]

_FOUR = 1 << 129
_END = _FOUR << 1
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

    def __invert__(self) -> Peers:
        """All other places of the number line; some of them are no addresses."""
        lasts = (-1, *(last for _, last in self.stretches))
        firsts = (*(first for first, _ in self.stretches), _END)
        gaps = ((last + 1, first - 1) for last, first in zip(lasts, firsts, strict=True))
        return Peers(tuple((first, last) for first, last in gaps if first <= last))

    def __sub__(self, other: Peers) -> Peers:
        return ~(~self | other)

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


ALL = Peers.of(EVERYBODY)


def read_filter(parent: Section) -> Peers | None:
    """The peers that `ip_filter` admits, `None` without a filter. Denied networks win."""
    filters = parent.mapping("ip_filter")
    if filters is None:
        return None
    allow, deny = read_networks(filters, "allow"), read_networks(filters, "deny")
    filters.close()
    if not allow and not deny:
        return None
    return (Peers.of(allow) if allow else ALL) - Peers.of(deny)


def read_networks(section: Section, key: str, *, required: bool = False) -> list[Network]:
    """The networks of a list; empty entries are ignored, with a note."""
    networks = []
    for path, text in section.entries(key, required=required) or ():
        if text is None or text == "":
            section.desk.left_out(path, "the entry is empty")
            continue
        try:
            networks.append(parse_network(text))
        except ValueError as error:
            section.desk.problem(path, str(error))
    return networks
