"""Parses the URLs of servers: of HTTP, MQTT and syslog.

No message repeats a URL, because a URL may contain a password.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Literal, NamedTuple
from urllib.parse import unquote

from holdfast.config.text.messages import shape, show
from holdfast.net.addresses import LAST_PORT, joined
from holdfast.net.hosts import HOST_FORM, host_and_port

if TYPE_CHECKING:
    from collections.abc import Mapping


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
    try:
        host, port = host_and_port(rest, least_port=least_port)
    except ValueError:
        allowed = f"allowed: {HOST_FORM}, and a port from {least_port} to {LAST_PORT}"
        raise ValueError(f"found an invalid host or port, {allowed}") from None
    return Remote(scheme, host, ports[scheme] if port is None else port)


HTTP_FORM = "http://host:port/path or https://host:port/path"
_HTTP_PORTS = {"http": 80, "https": 443}
_CREDENTIALS = {"u", "p", "token"}
"""The query parameters for a user, a password and a token: those of InfluxDB 1."""
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
    remote = parse_remote(scheme + mark + host if whole else text, _HTTP_PORTS, HTTP_FORM)
    if path and _PATH.fullmatch(path) is None:
        raise ValueError(f"found a path with blanks or other characters, allowed: {HTTP_FORM}")
    parameters = re.split("[&;]", path.partition("?")[2])
    names = {unquote(each.partition("=")[0]).lower() for each in parameters}
    if not names.isdisjoint(_CREDENTIALS):
        where = "set username and password_file, or token_file, instead"
        raise ValueError(f"found credentials in the query of the URL, allowed: none; {where}")
    return HttpTarget(remote.host, remote.port, remote.scheme == "https", path)


BROKER_FORM = "mqtt://host:port or mqtts://host:port"

_BROKER_PORTS = {"mqtt": 1883, "mqtts": 8883}


class Broker(NamedTuple):
    """The host and port of a broker, and whether the connection uses TLS."""

    host: str
    port: int
    secure: bool


def parse_broker(text: object) -> Broker:
    """Parses `scheme://host[:port]`. Raises `ValueError` for anything else."""
    remote = parse_remote(text, _BROKER_PORTS, BROKER_FORM)
    return Broker(remote.host, remote.port, remote.scheme == "mqtts")


SYSLOG_FORM = "udp://host:port, tcp://host:port or unix:///path"

_UNIX = "unix://"
_SYSLOG_PORTS = {"udp": 514, "tcp": 601}


class SyslogTarget(NamedTuple):
    """The transport to a receiver, and its host and port or the path of its socket."""

    transport: Literal["udp", "tcp", "unix"]
    target: tuple[str, int] | str


def parse_syslog(text: object) -> SyslogTarget:
    """Parses the URL of a receiver. Raises `ValueError` for anything else."""
    if isinstance(text, str) and text.startswith(_UNIX):
        path = text.removeprefix(_UNIX)
        if not path.startswith("/") or "\0" in path:
            raise ValueError(f"found {show(text)}, allowed: {SYSLOG_FORM}, with an absolute path")
        return SyslogTarget("unix", path)
    remote = parse_remote(text, _SYSLOG_PORTS, SYSLOG_FORM)
    return SyslogTarget("tcp" if remote.scheme == "tcp" else "udp", (remote.host, remote.port))
