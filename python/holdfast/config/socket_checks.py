"""Checks that no two parts of an appliance use the same socket or serial port."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.config.ip_addresses import Bind, parse_bind
from holdfast.config.lenient import mapping, parsed
from holdfast.config.listeners import CONNECTION_TYPES, DATAGRAM_TYPES, SERIAL_TYPES
from holdfast.config.unique import Owners
from holdfast.config.words import show

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

    _Server: TypeAlias = tuple[KeyPath, dict[Any, Any]]

SERVICES = ("rest", "gateway", "metrics")
"""Sections with an HTTP server."""


def check_sockets(data: object, report: Report) -> None:
    """Reports TCP binds that overlap, UDP binds that overlap, and serial ports used twice."""
    services = [((name,), mapping(mapping(data).get(name))) for name in SERVICES]
    _overlaps([*_listeners(data, CONNECTION_TYPES), *services], report)
    _overlaps(_listeners(data, DATAGRAM_TYPES), report)
    devices = Owners(report, "device")
    for path, listener in _listeners(data, SERIAL_TYPES):
        device = mapping(listener.get("serial")).get("device")
        if isinstance(device, str) and device and "\0" not in device:
            port = os.path.realpath(device)
            devices.claim((*path, "serial", "device"), port, show(device), path)


def _listeners(data: object, types: tuple[str, ...]) -> Iterator[_Server]:
    for name, listener in mapping(mapping(data).get("listeners")).items():
        if mapping(listener).get("type") in types:
            yield ("listeners", name), listener


def _overlaps(servers: Iterable[_Server], report: Report) -> None:
    earlier: list[tuple[KeyPath, Bind]] = []
    for path, server in servers:
        bind = parsed(parse_bind, server.get("bind"))
        if bind is None:
            continue
        for other_path, other in earlier:
            if bind.overlaps(other):
                line = report.line((*other_path, "bind"))
                of = f"{other} of {report.document.spell(other_path)} in line {line}"
                message = f"found {str(bind)!r}, which overlaps {of}"
                report.add((*path, "bind"), f"{message}, allowed: an unused address and port")
        earlier.append((path, bind))
