"""Parses the URL of a receiver of Raw Ingest packets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from holdfast.client.url import options_of, with_tls_in_folder
from holdfast.net.addresses import joined
from holdfast.net.tls import Tls

if TYPE_CHECKING:
    from pathlib import Path

RECEIVER_FORM = "raw://10.0.2.9:9000 or raw+tls://10.0.2.9:9000?ca=ca.pem"


@dataclass(frozen=True)
class Receiver:
    """A receiver of Raw Ingest packets."""

    host: str
    port: int
    tls: Tls | None = None
    """`None` for plain TCP."""

    def __str__(self) -> str:
        scheme = "raw" if self.tls is None else "raw+tls"
        return f"{scheme}://{joined(self.host, self.port)}"


def parse_receiver(url: str) -> Receiver:
    """Parses `raw://host:port` and `raw+tls://host:port`. Raises `ValueError` for anything else."""
    wrong = f"found {url!r}, allowed: {RECEIVER_FORM}"
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise ValueError(wrong) from None
    bare = url.partition("?")[0] == f"{parts.scheme}://{parts.netloc}"
    if parts.scheme not in ("raw", "raw+tls") or not bare or set(parts.netloc) & set(" @"):
        raise ValueError(wrong)
    if not host or not port:
        raise ValueError(wrong)
    chosen = options_of(url, parts.scheme, parts.query)
    if parts.scheme == "raw":
        return Receiver(host, port)
    try:
        return Receiver(host, port, Tls(**chosen))
    except ValueError as error:
        raise ValueError(f"{url!r}: {error}") from None


def receiver_in_folder(url: str, folder: Path) -> str:
    """The URL, with paths of files resolved relative to this folder."""
    tls = parse_receiver(url).tls
    return url if tls is None else with_tls_in_folder(url, tls, folder)
