"""Parses the URL of an HTTP server that values are sent to."""

from __future__ import annotations

import re
from typing import NamedTuple

from holdfast.config.remote import parse_remote

HTTP_FORM = "http://host:port/path or https://host:port/path"
_PORTS = {"http": 80, "https": 443}
_PATH = re.compile(r"[/?][!-~]*")


class HttpTarget(NamedTuple):
    """Host and port, whether the connection uses TLS, and the path with its query."""

    host: str
    port: int
    secure: bool
    path: str
    """Empty or `/` if the URL has none."""


def parse_http(text: object) -> HttpTarget:
    """Parses `scheme://host[:port][/path][?query]`. Raises `ValueError` for anything else."""
    whole = text if isinstance(text, str) else ""
    scheme, mark, rest = whole.partition("://")
    at = re.search("[/?]", rest)
    host, path = (rest, "") if at is None else (rest[: at.start()], rest[at.start() :])
    remote = parse_remote(scheme + mark + host if whole else text, _PORTS, HTTP_FORM)
    if path and _PATH.fullmatch(path) is None:
        raise ValueError(f"found a path with blanks or other characters, allowed: {HTTP_FORM}")
    return HttpTarget(remote.host, remote.port, remote.scheme == "https", path)
