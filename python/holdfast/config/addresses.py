"""IP addresses as a configuration writes them: where to listen, and whom to admit.

Only numbers, never host names: what is admitted must not depend on a name server. An IPv4 address
mapped into IPv6 is refused everywhere, because its IPv4 form is what is matched.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network
from typing import TYPE_CHECKING, TypeAlias

from holdfast.config.words import show

if TYPE_CHECKING:
    from collections.abc import Iterable

Address: TypeAlias = IPv4Address | IPv6Address
Network: TypeAlias = IPv4Network | IPv6Network

BIND_FORM = "address:port with an IP address, as in 127.0.0.1:502 or [::1]:502"
SOURCE_FORM = "a network or an address, as in 10.0.0.0/24, 10.0.0.7 or fd00::/64"

_BIND = re.compile(r"(?:\[(?P<six>[^\]]*)\]|(?P<four>[^:\[\]]*)):(?P<port>[0-9]{1,5})", re.ASCII)
_MAPPED = IPv6Network("::ffff:0:0/96")


@dataclass(frozen=True, slots=True)
class Bind:
    """An address and a TCP port to listen on; port 0 lets the system pick one."""

    address: Address
    port: int

    @property
    def host(self) -> str:
        """The address as text, without brackets."""
        return str(self.address)

    def __str__(self) -> str:
        return (
            f"[{self.address}]:{self.port}"
            if self.address.version == 6
            else f"{self.host}:{self.port}"
        )

    def overlaps(self, other: Bind) -> bool:
        """Whether both can't be open at once: `[::]` takes IPv4 connections too."""
        if self.port != other.port or self.port == 0:
            return False
        return self.address == other.address or self._takes(other) or other._takes(self)

    def _takes(self, other: Bind) -> bool:
        same_family = self.address.version == other.address.version
        return self.address.is_unspecified and (same_family or self.address.version == 6)


def parse_bind(text: object) -> Bind:
    """Raises `ValueError` for anything but an IP address and a port."""
    if isinstance(text, Bind):
        return text
    match = _BIND.fullmatch(text) if isinstance(text, str) else None
    if match is None or int(match["port"]) > 65535:
        raise ValueError(f"found {show(text)}, allowed: {BIND_FORM}")
    try:
        address: Address = (
            IPv4Address(match["four"]) if match["six"] is None else IPv6Address(match["six"])
        )
    except ValueError:
        raise ValueError(f"found {show(text)}, allowed: {BIND_FORM}") from None
    if isinstance(address, IPv6Address):
        if address.ipv4_mapped is not None:
            form = f"{address.ipv4_mapped}:{match['port']}"
            raise ValueError(f"found {show(text)}, write its IPv4 form {form}")
        if address.scope_id is not None and not re.fullmatch("[0-9]{1,9}", address.scope_id):
            raise ValueError(f"found {show(text)}, allowed behind '%': the number of an interface")
    return Bind(address, int(match["port"]))


def parse_source(text: object) -> Network:
    """Raises `ValueError` for anything but a network or a single address."""
    if isinstance(text, IPv4Network | IPv6Network):
        return text
    if not isinstance(text, str) or not re.fullmatch(r"[0-9a-fA-F.:]+(/[0-9]{1,3})?", text):
        raise ValueError(f"found {show(text)}, allowed: {SOURCE_FORM}")
    try:
        network = ipaddress.ip_network(text, strict=False)
    except ValueError:
        raise ValueError(f"found {show(text)}, allowed: {SOURCE_FORM}") from None
    four = _unmapped(network)
    if four is not None:
        raise ValueError(f"found {show(text)}, write its IPv4 form {four}")
    if str(network.network_address) != str(ipaddress.ip_address(text.partition("/")[0])):
        raise ValueError(f"found {show(text)}, which has host bits set: the network is {network}")
    return network


def _unmapped(network: Network) -> IPv4Network | None:
    if isinstance(network, IPv4Network) or not network.subnet_of(_MAPPED):
        return None
    low = int(network.network_address) & 0xFFFF_FFFF
    return IPv4Network((low, network.prefixlen - 96))


def covers(networks: Iterable[Network], network: Network) -> bool:
    """Whether all addresses of `network` are in some of `networks`."""
    if isinstance(network, IPv4Network):
        four = ipaddress.collapse_addresses(n for n in networks if isinstance(n, IPv4Network))
        return any(network.subnet_of(wider) for wider in four)
    six = ipaddress.collapse_addresses(n for n in networks if isinstance(n, IPv6Network))
    return any(network.subnet_of(wider) for wider in six)
