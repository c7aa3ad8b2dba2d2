"""The URL of a receiver of raw ingest packets: raw://host:port."""

from __future__ import annotations

from typing import NamedTuple
from urllib.parse import urlsplit

from holdfast.config.words import show

RECEIVER_FORM = "raw://host:port, as in raw://10.0.2.9:9000 or raw://[fd00::9]:9000"


class Receiver(NamedTuple):
    """The host and port of a receiver."""

    host: str
    port: int


def parse_receiver(text: object) -> Receiver:
    """Parses `raw://host:port`. Raises `ValueError` for anything else."""
    wrong = ValueError(f"found {show(text)}, allowed: {RECEIVER_FORM}")
    if not isinstance(text, str):
        raise wrong
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise wrong from None
    bare = text == f"raw://{parts.netloc}" and not set(text) & set(" @")
    if not bare or not host or not port:
        raise wrong
    return Receiver(host, port)
