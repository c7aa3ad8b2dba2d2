"""MQTT's own forms: the URL of a broker, and topic filters.

No message repeats a URL: someone may have written a password into it.
"""

from __future__ import annotations

import re
from ipaddress import IPv6Address
from typing import NamedTuple

from holdfast.config.words import shape, show

URL_FORM = "mqtt://host:port or mqtts://host:port"
LONGEST_TEXT = 65535

_PORTS = {"mqtt": 1883, "mqtts": 8883}
_HOST = re.compile(
    r"(?:\[(?P<six>[^\]]*)\]|(?P<name>[A-Za-z0-9][A-Za-z0-9_.-]{0,252}))(?::(?P<port>[0-9]{1,5}))?",
    re.ASCII,
)


class Broker(NamedTuple):
    """Where a broker is, and whether TLS is spoken to it."""

    host: str
    port: int
    secure: bool


def parse_broker(text: object) -> Broker:
    """Raises `ValueError` for anything but a scheme, a host and perhaps a port."""
    if not isinstance(text, str):
        raise ValueError(f"found {shape(text)}, allowed: {URL_FORM}")
    scheme, _, rest = text.partition("://")
    if scheme not in _PORTS or not rest:
        found = "no host" if scheme in _PORTS else "neither mqtt:// nor mqtts://"
        raise ValueError(f"found {found}, allowed: {URL_FORM}")
    if "@" in rest:
        where = "the user is username, the password is in the file that password_file names"
        raise ValueError(f"found a user in it, allowed: {URL_FORM}; {where}")
    if re.search("[/?#]", rest):
        raise ValueError(f"found more than host and port, allowed: {URL_FORM}")
    match = _HOST.fullmatch(rest)
    port = int(match["port"] or _PORTS[scheme]) if match else 0
    if match is None or not _is_host(match) or not 1 <= port <= 65535:
        allowed = "a host name or an address, IPv6 in brackets, and a port from 1 to 65535"
        raise ValueError(f"found a host or port that can't be, allowed: {allowed}")
    return Broker(match["name"] or match["six"], port, scheme == "mqtts")


def _is_host(match: re.Match[str]) -> bool:
    try:
        return match["six"] is None or bool(IPv6Address(match["six"]))
    except ValueError:
        return False


def parse_topic_filter(text: object) -> str:
    """Raises `ValueError` for what MQTT 5, 4.7, does not allow."""
    allowed = f"allowed: a topic filter of 1 to {LONGEST_TEXT} bytes"
    if not isinstance(text, str):
        raise ValueError(f"found {show(text)}, {allowed}")
    size = len(text.encode(errors="surrogatepass"))
    if not 1 <= size <= LONGEST_TEXT:
        raise ValueError(f"found text of {size} bytes, {allowed}")
    if re.search("[\0\ud800-\udfff]", text):
        raise ValueError(f"found {show(text)}, allowed: a topic filter without NUL and surrogates")
    *inner, last = text.split("/")
    if "#" in "".join(inner) or ("#" in last and last != "#"):
        raise ValueError(f"found {show(text)}, allowed: '#' only alone in the last level")
    if any("+" in level and level != "+" for level in (*inner, last)):
        raise ValueError(f"found {show(text)}, allowed: '+' only alone in its level")
    return text
