"""IP addresses and networks.

An IPv4-mapped IPv6 address (`::ffff:10.0.0.7`) is treated as the IPv4 address everywhere: it is
`unmapped` before any comparison.
"""

from __future__ import annotations

import ipaddress
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network
from typing import TYPE_CHECKING, Any, TypeAlias, overload

if TYPE_CHECKING:
    from collections.abc import Iterable

Address: TypeAlias = IPv4Address | IPv6Address
Network: TypeAlias = IPv4Network | IPv6Network

LAST_PORT = 65535

LOOPBACK: tuple[Network, ...] = (IPv4Network("127.0.0.0/8"), IPv6Network("::1/128"))
"""This machine."""

MAPPED = IPv6Network("::ffff:0:0/96")
"""The IPv4-mapped IPv6 addresses."""


@overload
def unmapped(found: Address) -> Address: ...


@overload
def unmapped(found: Network) -> Network: ...


def unmapped(found: Address | Network) -> Address | Network:
    """Returns the IPv4 form of an IPv4-mapped address or network; any other is unchanged."""
    if isinstance(found, IPv6Address):
        return found.ipv4_mapped or found
    if isinstance(found, IPv6Network) and found.subnet_of(MAPPED):
        low = int(found.network_address) & 0xFFFF_FFFF
        return IPv4Network((low, found.prefixlen - MAPPED.prefixlen))
    return found


def parse_address(text: str) -> Address:
    """Parses an address. Raises `ValueError` if it is not one."""
    return unmapped(ipaddress.ip_address(text))


def address_in(host: str) -> Address | None:
    """Parses a host that is an address, IPv6 with or without brackets; `None` for a name."""
    try:
        return parse_address(unbracketed(host))
    except ValueError:
        return None


def holds(networks: Iterable[Network], address: Address) -> bool:
    """Returns whether one of the networks contains the address."""
    plain = unmapped(address)
    return any(plain in network for network in networks)


def admits(sources: Iterable[Network], host: str) -> bool:
    """Returns whether one of the networks contains a host that is an address."""
    return holds(sources, parse_address(host))


def covers(networks: Iterable[Network], network: Network) -> bool:
    """Returns whether `networks` together contain every address of `network`."""
    same: list[Any] = [each for each in networks if each.version == network.version]
    return any(network.subnet_of(wider) for wider in ipaddress.collapse_addresses(same))


def bracketed(host: str) -> str:
    """Returns a host for a URL: an IPv6 address in brackets, which it may have already."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def unbracketed(host: str) -> str:
    """Returns a host without the brackets of a URL."""
    return host.removeprefix("[").removesuffix("]")


def joined(host: str, port: int) -> str:
    """Joins host and port: `10.0.0.9:502`, `[fd00::9]:502` or `plc.local:502`."""
    return f"{bracketed(host)}:{port}"


def reachable(host: str, sources: Iterable[Network] = LOOPBACK) -> str:
    """Returns the address at which a local client, if `sources` admit it, reaches a listening one.

    `::` also accepts IPv4, which every system has: `::1` only if `sources` admit no other.
    """
    if host not in {"0.0.0.0", "::"}:
        return host
    needs_ipv6 = host == "::" and admits(sources, "::1") and not admits(sources, "127.0.0.1")
    return "::1" if needs_ipv6 else "127.0.0.1"


def certificate_name(host: str) -> str:
    """Returns a host as a certificate names it: without brackets, in lower case."""
    address = address_in(host)
    if address is not None:
        return str(address)
    return unbracketed(host).lower().removesuffix(".")
