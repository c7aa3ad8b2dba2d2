"""Parses the URL of a remote server: a scheme, a host and an optional port.

No message repeats a URL, because a URL may contain a password.
"""

from __future__ import annotations

import re
from ipaddress import IPv6Address
from typing import TYPE_CHECKING, NamedTuple

from holdfast.config.words import shape
from holdfast.net.addresses import LAST_PORT, joined

if TYPE_CHECKING:
    from collections.abc import Mapping

_HOST = re.compile(
    r"(?:\[(?P<six>[^\]]*)\]|(?P<name>[A-Za-z0-9][A-Za-z0-9_.-]{0,252}))(?::(?P<port>[0-9]{1,5}))?",
    re.ASCII,
)


class Remote(NamedTuple):
    """Scheme, host and port of a server; the host is a name or an address without brackets."""

    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.scheme}://{joined(self.host, self.port)}"


def parse_remote(
    text: object, ports: Mapping[str, int], form: str, *, least_port: int = 1
) -> Remote:
    """Parses `scheme://host[:port]`; `ports` has the allowed schemes and their default ports.

    Raises `ValueError` for anything else.
    """
    if not isinstance(text, str):
        raise ValueError(f"found {shape(text)}, allowed: {form}")
    scheme, _, rest = text.partition("://")
    if scheme not in ports or not rest:
        neither = f"neither {' nor '.join(f'{known}://' for known in ports)}"
        found = "no host" if scheme in ports else neither
        raise ValueError(f"found {found}, allowed: {form}")
    if "@" in rest:
        where = "set username and password_file instead"
        raise ValueError(f"found a user in the URL, allowed: {form}; {where}")
    if re.search("[/?#]", rest):
        raise ValueError(f"found more than host and port, allowed: {form}")
    match = _HOST.fullmatch(rest)
    port = int(match["port"] or ports[scheme]) if match else 0
    if match is None or not _is_host(match) or not least_port <= port <= LAST_PORT:
        port_form = f"a port from {least_port} to {LAST_PORT}"
        allowed = f"allowed: a host name or an address, IPv6 in brackets, and {port_form}"
        raise ValueError(f"found an invalid host or port, {allowed}")
    return Remote(scheme, match["name"] or match["six"], port)


def _is_host(match: re.Match[str]) -> bool:
    try:
        return match["six"] is None or bool(IPv6Address(match["six"]))
    except ValueError:
        return False
