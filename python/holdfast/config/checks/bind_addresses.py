"""Checks that no two servers listen at the same address, and no two at the same serial port."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from holdfast.config.checks.common import Owners, items, until_invalid
from holdfast.config.models.base import types_of
from holdfast.config.models.listeners import SerialListener, TcpListener, UdpListener
from holdfast.config.models.services import HTTP_SERVICES
from holdfast.config.text.messages import show

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from holdfast.config.checks.common import Scope
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.config.values.ip_addresses import Bind


def check_binds(scope: Scope) -> None:
    """Reports TCP binds that overlap, UDP binds that overlap, and serial ports used twice."""
    _check_overlaps(scope, [*_listeners(scope, types_of(TcpListener)), *_services(scope)])
    _check_overlaps(scope, _listeners(scope, types_of(UdpListener)))
    devices = Owners(scope.report, "device")
    for path, listener in _listeners(scope, types_of(SerialListener)):
        with until_invalid():
            device = listener.serial.device
            port = os.path.realpath(device)
            devices.claim((*path, "serial", "device"), port, show(device), path)


def _listeners(scope: Scope, types: tuple[str, ...]) -> Iterator[tuple[KeyPath, Any]]:
    with until_invalid():
        for path, listener in items(("listeners",), scope.config.listeners):
            if listener.__dict__.get("type") in types:
                yield path, listener


def _services(scope: Scope) -> Iterator[tuple[KeyPath, Any]]:
    for name in HTTP_SERVICES:
        with until_invalid():
            if getattr(scope.config, name) is not None:
                yield (name,), getattr(scope.config, name)


def _check_overlaps(scope: Scope, servers: Iterable[tuple[KeyPath, Any]]) -> None:
    earlier: list[tuple[KeyPath, Bind]] = []
    for path, server in servers:
        with until_invalid():
            bind: Bind = server.bind
            for other_path, other in earlier:
                if bind.overlaps(other):
                    line = scope.report.line((*other_path, "bind"))
                    of = f"{other} of {scope.report.document.spell(other_path)} in line {line}"
                    message = f"found {str(bind)!r}, which overlaps {of}"
                    message += ", allowed: an unused address and port"
                    scope.report.add((*path, "bind"), message)
            earlier.append((path, bind))
