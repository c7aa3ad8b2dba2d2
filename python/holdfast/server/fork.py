"""Closes the sockets of native servers in forked children.

A child has copies of all file descriptors, but not the threads that use them. Without this, its
copies would keep the port of a server that its parent has stopped, with connections that nobody
answers.
"""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakSet

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast._core import Engine

    Bound = tuple[int, str, int]
    """Kind of socket, address and port."""

_engines: WeakSet[Engine] = WeakSet()
_bound: set[Bound] = set()
"""The sockets on which servers of this process listen, as of the last fork."""

_FOLDER = Path("/proc/self/fd" if sys.platform == "linux" else "/dev/fd")
_UNSPECIFIED = {socket.AF_INET: "0.0.0.0", socket.AF_INET6: "::"}
_MAX_DESCRIPTORS = 65_536
"""File descriptors that are tried where the system does not list them."""


def close_in_children(engine: Engine) -> None:
    """Closes all sockets of a running engine in each child that this process forks from now on."""
    _engines.add(engine)


def _note() -> None:
    kinds = {"tcp": socket.SOCK_STREAM, "udp": socket.SOCK_DGRAM}
    _bound.clear()
    for engine in list(_engines):
        _bound.update((int(kinds[kind]), host, port) for kind, host, port in engine.sockets)


def _close() -> None:
    if _bound:
        for number in _descriptors():
            if not _own(number).isdisjoint(_bound):
                os.close(number)
    _bound.clear()


def _descriptors() -> Iterable[int]:
    if sys.platform == "win32":
        raise AssertionError("only called on other systems")
    try:
        return sorted(int(each.name) for each in _FOLDER.iterdir())
    except OSError:
        return range(min(os.sysconf("SC_OPEN_MAX"), _MAX_DESCRIPTORS))


def _own(number: int) -> set[Bound]:
    """What a server would have bound, if this file descriptor is one of its sockets.

    An accepted connection has the address of its listener, or any if that is unspecified.
    """
    try:
        found = socket.socket(fileno=number)
    except OSError:
        return set()  # It is closed, or no socket.
    try:
        unspecified = _UNSPECIFIED.get(found.family)
        if unspecified is None:
            return set()
        host, port = found.getsockname()[:2]
        hosts = (unspecified, host.partition("%")[0])
        return {(int(found.type), each, port) for each in hosts}
    except OSError:
        return set()
    finally:
        found.detach()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_note, after_in_child=_close)
