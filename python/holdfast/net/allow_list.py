"""The targets that a service may connect to: networks with ports, and serial devices.

A name is resolved once. Each of its addresses is checked, and the connection is made to an allowed
address, never to the name. So a DNS answer that changes after the check has no effect. Multicast
and unspecified addresses are never allowed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from holdfast.net.addresses import (
    LAST_PORT,
    Network,
    address_in,
    bracketed,
    holds,
    parse_address,
    unmapped,
)
from holdfast.protocol import PORT, usual_port

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.net.addresses import Address
    from holdfast.net.resolver import Resolve
    from holdfast.types import Transport

ALL_PORTS = (1, LAST_PORT)


@dataclass(frozen=True, slots=True)
class AllowedNetwork:
    """An allowed network and its allowed ports."""

    network: Network
    ports: tuple[int, int] | None = None
    """The first and the last port. `None`: port 502 over every transport, and 802 over TLS."""

    def holds(self, address: Address, port: int, transport: Transport) -> bool:
        """Returns whether this entry allows a connection to the address and port."""
        if self.ports is None:
            fits = port in (PORT, usual_port(transport))
        else:
            fits = self.ports[0] <= port <= self.ports[1]
        return fits and holds((self.network,), address)

    def __str__(self) -> str:
        """Returns `NETWORK[:PORTS]`, the form of the gateway's allow list."""
        network = self.network
        whole = network.prefixlen == network.max_prefixlen
        prefix = "" if whole else f"/{network.prefixlen}"
        return f"{bracketed(str(network.network_address))}{prefix}{self._ports}"

    @property
    def _ports(self) -> str:
        if self.ports is None:
            return ""
        first, last = self.ports
        if self.ports == ALL_PORTS:
            return ":*"
        return f":{first}" if first == last else f":{first}-{last}"


@dataclass(frozen=True, slots=True)
class AllowedDevice:
    """An allowed serial device; requests must name exactly this path."""

    path: str

    def __str__(self) -> str:
        return self.path


AllowEntry: TypeAlias = AllowedNetwork | AllowedDevice


class NotAllowed(Exception):
    """The list allows none of the addresses of a host."""

    def __init__(self, host: str, found: tuple[str, ...]) -> None:
        self.host = host
        self.found = found
        """The addresses of a name; empty if the host is an address."""
        super().__init__(f"{host} is not allowed")


class AllowList:
    """The targets that a service may connect to."""

    def __init__(self, entries: Iterable[AllowEntry]) -> None:
        self.entries = tuple(entries)
        self.networks = tuple(each for each in self.entries if isinstance(each, AllowedNetwork))
        self._devices = {each.path for each in self.entries if isinstance(each, AllowedDevice)}

    def allows(self, address: Address, port: int, transport: Transport) -> bool:
        """Returns whether the list allows a connection to the address and port."""
        plain = unmapped(address)
        if plain.is_multicast or plain.is_unspecified:
            return False
        return any(entry.holds(plain, port, transport) for entry in self.networks)

    def allows_device(self, path: str) -> bool:
        """Returns whether the list allows the serial device."""
        return path in self._devices

    async def addresses(
        self, host: str, port: int, transport: Transport, resolve: Resolve
    ) -> tuple[str, ...]:
        """Returns the allowed addresses of a host, at least one.

        IPv4 is first, because devices with both families seldom answer Modbus on IPv6.
        Raises `NotAllowed`, and the exceptions of `resolve`.
        """
        literal = self.literal(host, port, transport)
        if literal is not None:
            return (literal,)
        named = await resolve(host)
        found = map(parse_address, named)
        allowed = [each for each in found if self.allows(each, port, transport)]
        if not allowed:
            raise NotAllowed(host, tuple(named))
        allowed.sort(key=lambda each: each.version)
        return tuple(dict.fromkeys(map(str, allowed)))

    def literal(self, host: str, port: int, transport: Transport) -> str | None:
        """Returns the address that a host is; `None` for a name. Raises `NotAllowed`."""
        address = address_in(host)
        if address is None:
            return None
        if not self.allows(address, port, transport):
            raise NotAllowed(host, ())
        return str(address)
