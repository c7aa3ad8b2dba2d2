"""Parses settings of the scanner: NATS servers, the subject prefix, and devices."""

from __future__ import annotations

import re
from ipaddress import IPv4Network, IPv6Network
from typing import TYPE_CHECKING, Literal

from holdfast.config.text.messages import show
from holdfast.config.values.ip_addresses import SOURCE_FORM, parse_source
from holdfast.config.values.urls import parse_remote
from holdfast.net.allow_list import ALL_PORTS, AllowedDevice, AllowedNetwork

if TYPE_CHECKING:
    from holdfast.config.values.urls import Remote
    from holdfast.net.allow_list import AllowEntry

SERVER_FORM = "nats://host:port or tls://host:port"
SERVER_PORT = 4222
PREFIX = "modbus"
PREFIX_FORM = "letters, digits, '_' and '-', separated by dots"
POLLABLE_FORM = f"{SOURCE_FORM}, or a serial device, as in /dev/ttyUSB0 or COM3"

DEFAULT_MAX_DEVICES = 5000
DEFAULT_MAX_TAGS = 500_000
"""Limits of the scanner; `DEFAULT_MAX_TAGS` counts the tags of all devices."""

Dialect = Literal["tentacle", "tentacle-next"]
"""The programs that the scanner serves; `tentacle` is tentacle-modbus and its callers."""

DIALECT: Dialect = "tentacle"
"""The dialect without a setting."""

Publish = Literal["scan", "change"]
Writes = Literal["tags", "explicit", "none"]
"""Tags that may be written: all not declared read-only, those declared writable, or none."""

_MEMBER = re.compile("[A-Za-z0-9_-]{1,32}")
"""Names of fleets are parts of names of buckets, which have no dots."""

WANTS = "_wants"
"""The end of the name of the bucket of subscriptions: the rest is the bucket of leases."""

PARTITIONS = 256
MAX_PARTITIONS = 4096
"""The partitions of a fleet: the default, and the most."""

SCAN_RATE = 1000
TIMEOUT = 3000
"""Defaults of subscribe requests in milliseconds."""

MIN_SCAN_RATE, MAX_SCAN_RATE = 50, 86_400_000
MIN_TIMEOUT, MAX_TIMEOUT = 10, 30_000
"""Limits of subscribe requests in milliseconds."""
MAX_DEADBAND = 1e300

MIN_PING_INTERVAL, MAX_PING_INTERVAL = 0.1, 3600.0
MAX_PINGS = 100

_PORTS = {"nats": SERVER_PORT, "tls": SERVER_PORT}
_PREFIX = re.compile(r"[A-Za-z0-9_-]{1,64}(\.[A-Za-z0-9_-]{1,64})*", re.ASCII)
_NUMBER = re.compile(r"[0-9a-fA-F.:/]+", re.ASCII)
_SERIAL = re.compile(r"/[^\0]+|COM[0-9]+|\\\\\.\\[^\0]+", re.ASCII)


def parse_server(text: object, *, least_port: int = 1) -> Remote:
    """Parses a server's URL. Raises `ValueError`, without the URL in the message."""
    return parse_remote(text, _PORTS, SERVER_FORM, least_port=least_port)


def parse_member(text: object) -> str:
    """Checks the name of a node of a fleet. Raises `ValueError` for anything else."""
    if isinstance(text, str) and _MEMBER.fullmatch(text):
        return text
    raise ValueError(f"found {show(text)}, allowed: 1 to 32 letters, digits, - and _")


def parse_fleet(text: object) -> str:
    """Checks the name of a fleet. Raises `ValueError` for anything else."""
    name = parse_member(text)
    if name.endswith(WANTS):
        taken = f"a name that does not end in {WANTS}, as the bucket of another fleet does"
        raise ValueError(f"found {show(text)}, allowed: {taken}")
    return name


def parse_prefix(text: object) -> str:
    """Checks a subject prefix. Raises `ValueError` for anything else."""
    if isinstance(text, str) and _PREFIX.fullmatch(text):
        return text
    raise ValueError(f"found {show(text)}, allowed: {PREFIX_FORM}")


def check_dialect(dialect: Dialect, prefix: str) -> None:
    """Raises `ValueError` if the prefix can't be a part of the bucket that the dialect watches."""
    if dialect == "tentacle-next" and "." in prefix:
        raise ValueError(f"found {show(prefix)}, allowed with dialect tentacle-next: no dots")


def parse_pollable(text: object) -> AllowEntry:
    """Parses an entry: a network or an address, with all ports, or a serial device.

    Raises `ValueError` for anything else.
    """
    if isinstance(text, AllowedNetwork | AllowedDevice):
        return text
    if isinstance(text, str) and _SERIAL.fullmatch(text):
        return AllowedDevice(text)
    is_number = isinstance(text, str) and _NUMBER.fullmatch(text)
    if is_number or isinstance(text, IPv4Network | IPv6Network):
        return AllowedNetwork(parse_source(text), ALL_PORTS)
    raise ValueError(f"found {show(text)}, allowed: {POLLABLE_FORM}")


def written_pollable(entry: AllowEntry) -> str:
    """The text that `parse_pollable` accepts; networks have no ports, as all are allowed."""
    return str(entry.network) if isinstance(entry, AllowedNetwork) else entry.path
