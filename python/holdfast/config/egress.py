"""Whom the gateway may connect to, as text: a network and ports."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast.client.target import PORT, TLS_PORT
from holdfast.config.addresses import Address, Network, parse_source
from holdfast.config.words import show

if TYPE_CHECKING:
    from holdfast.client.target import Transport

FORM = (
    "NETWORK[:PORTS] as 10.0.0.0/8, 10.0.0.5:502, 10.0.0.0/24:502-510, 10.0.0.5:* or "
    "[fd00::]/8:502; without ports it is 502, and 802 with TLS"
)
LAST_PORT = 65535

_ENTRY = re.compile(
    r"(?:\[(?P<six>[0-9a-fA-F:.]*)\](?P<prefix>/[0-9]{1,3})?|(?P<four>[0-9./]+))"
    r"(?::(?P<ports>\*|[0-9]{1,5}(?:-[0-9]{1,5})?))?",
    re.ASCII,
)


@dataclass(frozen=True)
class Allowed:
    """A network and the ports in it; without ports it is 502, and 802 with TLS."""

    network: Network
    ports: tuple[int, int] | None = None
    """The first and the last."""

    def holds(self, address: Address, port: int, transport: Transport) -> bool:
        """Whether a connection to this port of this address is one of them."""
        if self.ports is None:
            fits = port == PORT or (port == TLS_PORT and transport == "tls")
        else:
            fits = self.ports[0] <= port <= self.ports[1]
        return fits and address in self.network

    def __str__(self) -> str:
        network = self.network
        whole = network.prefixlen == network.max_prefixlen
        prefix = "" if whole else f"/{network.prefixlen}"
        host = str(network.network_address)
        return f"{f'[{host}]' if network.version == 6 else host}{prefix}{self._ports}"

    @property
    def _ports(self) -> str:
        if self.ports is None:
            return ""
        first, last = self.ports
        if self.ports == (1, LAST_PORT):
            return ":*"
        return f":{first}" if first == last else f":{first}-{last}"


def parse_allowed(text: object) -> Allowed:
    """An entry of the list. Raises `ValueError`, which says what is allowed."""
    if isinstance(text, Allowed):
        return text
    match = _ENTRY.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"found {show(text)}, allowed: {FORM}")
    host = match["four"] or f"{match['six']}{match['prefix'] or ''}"
    network = parse_source(host)
    if match["six"] is not None and network.version != 6:
        raise ValueError(f"found {show(text)}, brackets are for IPv6")
    if match["ports"] is None:
        return Allowed(network)
    first, last = _ports(match["ports"])
    if not 1 <= first <= last <= LAST_PORT:
        raise ValueError(f"found {show(text)}, allowed are ports 1 to 65535, lower ones first")
    return Allowed(network, (first, last))


def _ports(text: str) -> tuple[int, int]:
    if text == "*":
        return 1, LAST_PORT
    first, _, last = text.partition("-")
    return int(first), int(last or first)
