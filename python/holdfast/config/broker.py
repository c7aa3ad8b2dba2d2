"""Parses MQTT settings: the URL of a broker, and topic filters."""

from __future__ import annotations

import re
from typing import NamedTuple

from holdfast.config.remote import parse_remote
from holdfast.config.words import show

URL_FORM = "mqtt://host:port or mqtts://host:port"
MAX_TEXT = 65535

_PORTS = {"mqtt": 1883, "mqtts": 8883}


class Broker(NamedTuple):
    """The host and port of a broker, and whether the connection uses TLS."""

    host: str
    port: int
    secure: bool


def parse_broker(text: object) -> Broker:
    """Parses `scheme://host[:port]`. Raises `ValueError` for anything else."""
    remote = parse_remote(text, _PORTS, URL_FORM)
    return Broker(remote.host, remote.port, remote.scheme == "mqtts")


def parse_topic_filter(text: object) -> str:
    """Checks a topic filter. Raises `ValueError` if MQTT 5, section 4.7, does not allow it."""
    allowed = f"allowed: a topic filter of 1 to {MAX_TEXT} bytes"
    if not isinstance(text, str):
        raise ValueError(f"found {show(text)}, {allowed}")
    size = len(text.encode(errors="surrogatepass"))
    if not 1 <= size <= MAX_TEXT:
        raise ValueError(f"found text of {size} bytes, {allowed}")
    if re.search("[\0\ud800-\udfff]", text):
        raise ValueError(f"found {show(text)}, allowed: a topic filter without NUL or surrogates")
    *inner, last = text.split("/")
    if "#" in "".join(inner) or ("#" in last and last != "#"):
        raise ValueError(f"found {show(text)}, allowed: '#' only alone in the last level")
    if any("+" in level and level != "+" for level in (*inner, last)):
        raise ValueError(f"found {show(text)}, allowed: '+' only alone in its level")
    return text
