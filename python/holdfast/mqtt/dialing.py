"""Opens a TCP or TLS connection to a broker. A stop interrupts every step."""

from __future__ import annotations

import errno
import os
import socket
import ssl
import time
from concurrent.futures import wait
from typing import TYPE_CHECKING, Any

from holdfast.net.resolver import CONFIGURED

if TYPE_CHECKING:
    from holdfast.mqtt.waiting import Waiter
    from holdfast.net.resolver import SocketAddress

CONNECT_TIMEOUT = 10.0
"""Seconds for the connection to one address of the broker, including the TLS handshake."""

CHECK_INTERVAL = 0.1
"""Seconds between checks for a stop during a name lookup."""

_UNDER_WAY = {0, errno.EINPROGRESS, errno.EWOULDBLOCK}


def dial(host: str, port: int, context: ssl.SSLContext | None, waiter: Waiter) -> socket.socket:
    """Returns a non-blocking connection to the first address that accepts one.

    Raises `OSError` when no address does, and `Ended` after a stop.
    """
    failure = OSError(f"{host} has no address")
    for family, address in _addresses(host, port, waiter):
        try:
            return _open(family, address, host, context, waiter)
        except OSError as error:
            failure = error
    raise failure


def _addresses(host: str, port: int, waiter: Waiter) -> list[SocketAddress]:
    asked = CONFIGURED.look_up(host, port)
    try:
        while not wait((asked,), CHECK_INTERVAL).done:
            waiter.check()
    finally:
        asked.cancel()
    return asked.result()


def _open(
    family: int, address: Any, host: str, context: ssl.SSLContext | None, waiter: Waiter
) -> socket.socket:
    deadline = time.monotonic() + CONNECT_TIMEOUT
    connection = socket.socket(family, socket.SOCK_STREAM)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _raise_for(connection.connect_ex(address))
        _wait(connection, waiter, deadline, write=True)
        _raise_for(connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
        if context is None:
            return connection
        secured = context.wrap_socket(
            connection, server_hostname=host, do_handshake_on_connect=False
        )
        connection = secured
        while True:
            try:
                secured.do_handshake()
                return secured
            except ssl.SSLWantReadError:
                _wait(connection, waiter, deadline, read=True)
            except ssl.SSLWantWriteError:
                _wait(connection, waiter, deadline, write=True)
    except BaseException:
        connection.close()
        raise


def _raise_for(code: int) -> None:
    if code not in _UNDER_WAY:
        raise OSError(code, os.strerror(code))


def _wait(
    connection: socket.socket,
    waiter: Waiter,
    deadline: float,
    *,
    read: bool = False,
    write: bool = False,
) -> None:
    seconds = deadline - time.monotonic()
    if seconds <= 0 or not any(waiter.wait(connection, read=read, write=write, seconds=seconds)):
        raise TimeoutError(f"no answer within {CONNECT_TIMEOUT:g} s")
