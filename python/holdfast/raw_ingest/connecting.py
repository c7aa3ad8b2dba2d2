"""Connects to receivers, within a deadline."""

from __future__ import annotations

import asyncio
import socket
import time
from typing import TYPE_CHECKING

from holdfast.net.resolver import Resolver

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.net.resolver import SocketAddress

_RESOLVER = Resolver()


async def connected(host: str, port: int, deadline: float) -> socket.socket:
    """Connects to the first address of the host that accepts.

    Each address gets a share of the remaining time, so that one dead address does not use it up.
    """
    loop = asyncio.get_running_loop()
    found = await asyncio.wrap_future(_RESOLVER.look_up(host, port))
    for others, (family, address) in _countdown(found):
        try:
            connection = socket.socket(family)
            try:
                _prepare(connection)
                async with asyncio.timeout((deadline - loop.time()) / (others + 1)):
                    await loop.sock_connect(connection, address)
            except BaseException:
                connection.close()
                raise
            return connection
        except OSError:
            if not others:
                raise
    raise OSError("the host has no address")


def connected_sync(host: str, port: int, deadline: float) -> socket.socket:
    """Like `connected`, without an event loop."""
    found = _RESOLVER.wait_for(host, port, left(deadline))
    for others, (family, address) in _countdown(found):
        try:
            connection = socket.socket(family)
            try:
                _prepare(connection)
                connection.settimeout(left(deadline) / (others + 1))
                connection.connect(address)
                connection.setblocking(False)
            except BaseException:
                connection.close()
                raise
            return connection
        except OSError:
            if not others:
                raise
    raise OSError("the host has no address")


def _countdown(found: Sequence[SocketAddress]) -> Iterator[tuple[int, SocketAddress]]:
    """The addresses, each with the number of addresses after it."""
    return zip(reversed(range(len(found))), found, strict=True)


def _prepare(connection: socket.socket) -> None:
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def left(deadline: float) -> float:
    """The seconds until a deadline. Raises `TimeoutError` after it."""
    seconds = deadline - time.monotonic()
    if seconds <= 0:
        raise TimeoutError
    return seconds
