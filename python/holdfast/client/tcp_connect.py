"""Connects over TCP to the first address of a host that accepts, before a deadline.

Each address gets a share of the remaining time, so that one dead address does not use it up.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import struct
import sys
import time
from typing import TYPE_CHECKING

from holdfast.net.resolver import CONFIGURED

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.net.resolver import SocketAddress


async def addresses(host: str, port: int) -> list[SocketAddress]:
    """Returns the addresses of a host, in the system's order. Raises `OSError`.

    A cancellation ends it at once, and no event loop waits for the lookup when it is closed.
    """
    found = CONFIGURED.look_up(host, port)
    # An address needs no lookup.
    return found.result() if found.done() else await asyncio.wrap_future(found)


async def connected(candidates: Sequence[SocketAddress], deadline: float) -> socket.socket:
    """Returns a connection to the first of the addresses that accepts.

    `deadline` is a time of the clock of the event loop. Raises `OSError`.
    """
    loop = asyncio.get_running_loop()
    for others, (family, address) in _countdown(candidates):
        try:
            with _prepared(family) as connection:
                async with asyncio.timeout((deadline - loop.time()) / (others + 1)):
                    await loop.sock_connect(connection, address)
            return connection
        except OSError:
            if not others:
                raise
    raise OSError("the host has no address")


def connected_sync(host: str, port: int, deadline: float) -> socket.socket:
    """Like `addresses` and `connected`, without an event loop."""
    candidates = CONFIGURED.wait_for(host, port, remaining_s(deadline))
    for others, (family, address) in _countdown(candidates):
        try:
            with _prepared(family) as connection:
                connection.settimeout(remaining_s(deadline) / (others + 1))
                connection.connect(address)
                connection.setblocking(False)
            return connection
        except OSError:
            if not others:
                raise
    raise OSError("the host has no address")


def limit_resends(connection: socket.socket, limit_s: int) -> None:
    """Limits how long the system repeats what the device does not acknowledge, as in the core.

    Without it a write that was given up could arrive minutes later. Only Linux has such a limit.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, limit_s * 1000)


def _countdown(candidates: Sequence[SocketAddress]) -> Iterator[tuple[int, SocketAddress]]:
    """The addresses, each with the number of addresses after it."""
    return zip(reversed(range(len(candidates))), candidates, strict=True)


@contextlib.contextmanager
def _prepared(family: int) -> Iterator[socket.socket]:
    """A socket, which is closed if connecting fails. Raises `OSError` if it is its own peer."""
    connection = socket.socket(family)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield connection
        if _is_to_itself(connection):
            # Closed without a reset, it would keep the port from its device for a minute.
            linger = struct.pack("hh" if sys.platform == "win32" else "ii", 1, 0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
    except BaseException:
        connection.close()
        raise


def _is_to_itself(connection: socket.socket) -> bool:
    """Whether a connection has one socket at both ends, as in the core: its replies are an echo.

    While nobody listens at a port of this machine, the system may choose it for the client.
    """
    try:
        return bool(connection.getsockname() == connection.getpeername())
    except OSError:
        return False  # It has already ended.


def remaining_s(deadline: float) -> float:
    """The seconds until a deadline. Raises `TimeoutError` after it."""
    seconds = deadline - time.monotonic()
    if seconds <= 0:
        raise TimeoutError
    return seconds
