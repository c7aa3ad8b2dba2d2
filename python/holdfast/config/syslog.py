"""Parses the URL of a syslog receiver."""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

from holdfast.config.remote import parse_remote
from holdfast.config.words import show

URL_FORM = "udp://host:port, tcp://host:port or unix:///path"

_UNIX = "unix://"
_PORTS = {"udp": 514, "tcp": 601}

Facility: TypeAlias = Literal[
    "auth",
    "authpriv",
    "daemon",
    "user",
    "local0",
    "local1",
    "local2",
    "local3",
    "local4",
    "local5",
    "local6",
    "local7",
]


class SyslogTarget(NamedTuple):
    """The transport to a receiver, and its host and port or the path of its socket."""

    transport: Literal["udp", "tcp", "unix"]
    target: tuple[str, int] | str


def parse_syslog(text: object) -> SyslogTarget:
    """Parses the URL of a receiver. Raises `ValueError` for anything else."""
    if isinstance(text, str) and text.startswith(_UNIX):
        path = text.removeprefix(_UNIX)
        if not path.startswith("/") or "\0" in path:
            raise ValueError(f"found {show(text)}, allowed: {URL_FORM}, with an absolute path")
        return SyslogTarget("unix", path)
    remote = parse_remote(text, _PORTS, URL_FORM)
    return SyslogTarget("tcp" if remote.scheme == "tcp" else "udp", (remote.host, remote.port))
