"""IP addresses in a configuration: addresses to listen on, and sources to admit.

Host names are not allowed, because admission must not depend on a name server. IPv4-mapped IPv6
addresses are refused, because peers are matched by their IPv4 form.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network

from holdfast.config.text.messages import show
from holdfast.net.addresses import LAST_PORT, Address, Network, joined, unmapped

BIND_FORM = "address:port with an IP address, as in 127.0.0.1:502 or, with quotes, '[::1]:502'"
PEER_FORM = "an IP address, as in 10.0.0.7 or fd00::7"
SOURCE_FORM = "a network or an address, as in 10.0.0.0/24, 10.0.0.7 or fd00::/64"

_BIND = re.compile(r"(?:\[(?P<six>[^\]]*)\]|(?P<four>[^:\[\]]*)):(?P<port>[0-9]{1,5})", re.ASCII)


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
        return joined(self.host, self.port)

    def overlaps(self, other: Bind) -> bool:
        """Whether both can't be open at once: `[::]` also accepts IPv4 connections."""
        if self.port != other.port or self.port == 0:
            return False
        return self.address == other.address or self._takes(other) or other._takes(self)

    def _takes(self, other: Bind) -> bool:
        same_family = self.address.version == other.address.version
        return self.address.is_unspecified and (same_family or self.address.version == 6)


def parse_bind(text: object) -> Bind:
    """Parses `address:port`. Raises `ValueError` for anything else."""
    if isinstance(text, Bind):
        return text
    match = _BIND.fullmatch(text) if isinstance(text, str) else None
    if match is None or int(match["port"]) > LAST_PORT:
        raise ValueError(f"found {show(text)}, allowed: {BIND_FORM}")
    try:
        address: Address = (
            IPv4Address(match["four"]) if match["six"] is None else IPv6Address(match["six"])
        )
    except ValueError:
        raise ValueError(f"found {show(text)}, allowed: {BIND_FORM}") from None
    if isinstance(address, IPv6Address):
        four = unmapped(address)
        if four != address:
            form = joined(str(four), int(match["port"]))
            raise ValueError(f"found {show(text)}, write its IPv4 form {form}")
        if address.scope_id is not None and not re.fullmatch("[0-9]{1,9}", address.scope_id):
            raise ValueError(f"found {show(text)}, allowed after '%': an interface number")
    return Bind(address, int(match["port"]))


def parse_source(text: object) -> Network:
    """Parses a network or a single address. Raises `ValueError` for anything else."""
    if isinstance(text, IPv4Network | IPv6Network):
        return text
    if not isinstance(text, str) or not re.fullmatch(r"[0-9a-fA-F.:]+(/[0-9]{1,3})?", text):
        raise ValueError(f"found {show(text)}, allowed: {SOURCE_FORM}")
    try:
        network = ipaddress.ip_network(text, strict=False)
    except ValueError:
        raise ValueError(f"found {show(text)}, allowed: {SOURCE_FORM}") from None
    four = unmapped(network)
    if four != network:
        raise ValueError(f"found {show(text)}, write its IPv4 form {four}")
    if str(network.network_address) != str(ipaddress.ip_address(text.partition("/")[0])):
        raise ValueError(f"found {show(text)}, which has host bits set: the network is {network}")
    return network


def parse_peer(text: object) -> str:
    """Checks the address of one peer. Raises `ValueError` for anything else."""
    if not isinstance(text, str) or not re.fullmatch(r"[0-9a-fA-F.:]+", text):
        raise ValueError(f"found {show(text)}, allowed: {PEER_FORM}")
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        raise ValueError(f"found {show(text)}, allowed: {PEER_FORM}") from None
    four = unmapped(address)
    if four != address:
        raise ValueError(f"found {show(text)}, write its IPv4 form {four}")
    return str(address)
