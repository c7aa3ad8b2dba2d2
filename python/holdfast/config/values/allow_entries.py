"""Parses entries of the gateway's allow list: a network and ports."""

from __future__ import annotations

import re

from holdfast.config.text.messages import show
from holdfast.config.values.ip_addresses import parse_source
from holdfast.net.addresses import LAST_PORT
from holdfast.net.allow_list import ALL_PORTS, AllowedNetwork

FORM = (
    "NETWORK[:PORTS], as in 10.0.0.0/8, 10.0.0.5:502, 10.0.0.0/24:502-510, 10.0.0.5:* or, with "
    "quotes, '[fd00::]/8:502'; default ports: 502, with TLS also 802"
)

_ENTRY = re.compile(
    r"(?:\[(?P<six>[0-9a-fA-F:.]*)\](?P<prefix>/[0-9]{1,3})?|(?P<four>[0-9./]+))"
    r"(?::(?P<ports>\*|[0-9]{1,5}(?:-[0-9]{1,5})?))?",
    re.ASCII,
)


def parse_allowed(text: object) -> AllowedNetwork:
    """Parses an entry. Raises `ValueError` that says what is allowed."""
    if isinstance(text, AllowedNetwork):
        return text
    match = _ENTRY.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"found {show(text)}, allowed: {FORM}")
    host = match["four"] or f"{match['six']}{match['prefix'] or ''}"
    network = parse_source(host)
    if match["six"] is not None and network.version != 6:
        raise ValueError(f"found {show(text)}, allowed in brackets: an IPv6 network")
    if match["ports"] is None:
        return AllowedNetwork(network)
    first, last = _ports(match["ports"])
    if not 1 <= first <= last <= LAST_PORT:
        raise ValueError(
            f"found {show(text)}, allowed: ports 1 to {LAST_PORT}, the lower port first"
        )
    return AllowedNetwork(network, (first, last))


def _ports(text: str) -> tuple[int, int]:
    if text == "*":
        return ALL_PORTS
    first, _, last = text.partition("-")
    return int(first), int(last or first)
