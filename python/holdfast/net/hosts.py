"""Hosts as they are written: IP addresses and names, with and without a port.

A text that ends in a number and is no IP address is not a host: resolvers take `10.0.0.010` for
10.0.0.8 and `192.168.1` for 192.168.0.1, so requests would go to another device.
"""

from __future__ import annotations

import re

from holdfast.net.addresses import LAST_PORT, address_in
from holdfast.runtime.text import quote

HOST_FORM = (
    "a host name, an IPv4 address of four numbers without leading zeros, or an IPv6 address in "
    "brackets"
)

_LETTER = "A-Za-z0-9_\x80-\U0010ffff"
_LABEL = f"[{_LETTER}]([{_LETTER}-]{{0,61}}[{_LETTER}])?"
_NAME = re.compile(rf"(?=.{{1,253}}\Z)({_LABEL}\.)*(?!([0-9]+|0[xX][0-9a-fA-F]*)\Z){_LABEL}")
_ADDRESS_6 = re.compile(r"[0-9a-f.]*:[0-9a-f:.]*(%[!-~]+)?")
_NETLOC = re.compile(r"(?:\[(?P<six>[^\[\]]*)\]|(?P<name>[^:\[\]]*))(?::(?P<port>[^:]*))?")


def is_host_name(text: str) -> bool:
    """Whether text can be the name of a host; as in Docker and Windows, it may contain `_`.

    Letters may be of any language, but none that resolvers replace by others, as wide digits.
    """
    return _NAME.fullmatch(text) is not None and (text.isascii() or _has_own_letters(text.lower()))


def _has_own_letters(text: str) -> bool:
    try:
        return text.encode("idna").decode("idna") == text
    except UnicodeError:
        return False


def is_host(text: str) -> bool:
    """Whether text is an IP address, IPv6 with or without brackets, or can be a name."""
    return address_in(text) is not None or is_host_name(text.removesuffix("."))


def host_and_port(netloc: str, *, least_port: int = 1) -> tuple[str, int | None]:
    """Splits `host[:port]` of a URL, with IPv6 in brackets; the host is in lower case.

    Raises `ValueError` that says what is allowed.
    """
    match = _NETLOC.fullmatch(netloc)
    if match is None:
        raise ValueError(f"the host is {quote(netloc)}, allowed: {HOST_FORM}")
    six, name = match["six"], match["name"]
    host = name.lower() if six is None else _unescaped(six)
    if not is_host(host) or (six is not None and _ADDRESS_6.fullmatch(host) is None):
        raise ValueError(f"the host is {quote(six or name)}, allowed: {HOST_FORM}")
    port = match["port"]
    if port is None:
        return host, None
    if not re.fullmatch("[0-9]{1,5}", port) or not least_port <= int(port) <= LAST_PORT:
        found = port if re.fullmatch("[0-9]{1,20}", port) else quote(port)
        raise ValueError(f"port {found}, allowed: {least_port} to {LAST_PORT}")
    return host, int(port)


def _unescaped(six: str) -> str:
    """An IPv6 address, whose zone a URL separates with `%25` (RFC 6874) or `%`."""
    address, mark, zone = six.partition("%")
    return f"{address.lower()}{mark}{re.sub('^25(?=.)', '', zone)}"
