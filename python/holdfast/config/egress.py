"""Whom the gateway may connect to, as text: a network and ports."""

from __future__ import annotations

import re
from dataclasses import dataclass

from holdfast.config.addresses import Address, Network, parse_source
from holdfast.config.words import show
from holdfast.target import PORT

FORM = (
    "NETWORK[:PORTS] as 10.0.0.0/8, 10.0.0.5:502, 10.0.0.0/24:502-510, 10.0.0.5:* or "
    "[fd00::]/8:502; without ports it is 502"
)
LAST_PORT = 65535

_ENTRY = re.compile(
    r"(?:\[(?P<six>[0-9a-fA-F:.]*)\](?P<prefix>/[0-9]{1,3})?|(?P<four>[0-9./]+))"
    r"(?::(?P<ports>\*|[0-9]{1,5}(?:-[0-9]{1,5})?))?",
    re.ASCII,
)


@dataclass(frozen=True)
class Allowed:
    """A network and the ports in it."""

    network: Network
    first: int
    last: int

    def holds(self, address: Address, port: int) -> bool:
        """Whether a connection to this port of this address is one of them."""
        return self.first <= port <= self.last and address in self.network

    def __str__(self) -> str:
        network = self.network
        whole = network.prefixlen == network.max_prefixlen
        prefix = "" if whole else f"/{network.prefixlen}"
        host = str(network.network_address)
        ports = str(self.first) if self.first == self.last else f"{self.first}-{self.last}"
        if (self.first, self.last) == (1, LAST_PORT):
            ports = "*"
        return f"[{host}]{prefix}:{ports}" if network.version == 6 else f"{host}{prefix}:{ports}"


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
    first, last = _ports(match["ports"])
    if not 1 <= first <= last <= LAST_PORT:
        raise ValueError(f"found {show(text)}, allowed are ports 1 to 65535, lower ones first")
    return Allowed(network, first, last)


def _ports(text: str | None) -> tuple[int, int]:
    if text is None:
        return PORT, PORT
    if text == "*":
        return 1, LAST_PORT
    first, _, last = text.partition("-")
    return int(first), int(last or first)
