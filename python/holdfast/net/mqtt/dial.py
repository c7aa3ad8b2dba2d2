"""Opens a TCP or TLS connection to a broker. A stop interrupts every step."""

from __future__ import annotations

import errno
import socket
import time
from concurrent.futures import wait
from typing import TYPE_CHECKING, Any

from holdfast.net.mqtt.broker_socket import BrokerSocket
from holdfast.net.resolver import CONFIGURED
from holdfast.net.secure_channel import SecureChannel
from holdfast.runtime.text import error_text

if TYPE_CHECKING:
    from holdfast.net.mqtt.waiter import Waiter
    from holdfast.net.resolver import SocketAddress
    from holdfast.net.tls import Tls

READ_BYTES = 65_536

CONNECT_TIMEOUT_S = 10.0
"""Seconds for the connection to one address of the broker, including the TLS handshake."""

CONNACK_TIMEOUT_S = 10.0
"""Seconds to wait for the broker's CONNACK."""

CHECK_INTERVAL_S = 0.1
"""Seconds between checks for a stop during a name lookup."""

_UNDER_WAY = {0, errno.EINPROGRESS, errno.EWOULDBLOCK}


def dial(host: str, port: int, tls: Tls | None, waiter: Waiter) -> BrokerSocket:
    """Returns a non-blocking connection to the first address that accepts one.

    Raises `OSError` when no address does, or a file of `tls` is unusable, and `Ended` after a stop.
    """
    failure = OSError(f"{host} has no address")
    for family, address in _addresses(host, port, waiter):
        try:
            channel = None if tls is None else SecureChannel(host, tls)
            return _open(family, address, channel, waiter)
        except OSError as error:
            failure = error
    raise failure


def _addresses(host: str, port: int, waiter: Waiter) -> list[SocketAddress]:
    lookup = CONFIGURED.look_up(host, port)
    try:
        while not wait((lookup,), CHECK_INTERVAL_S).done:
            waiter.check()
    finally:
        lookup.cancel()
    return lookup.result()


def _open(family: int, address: Any, channel: SecureChannel | None, waiter: Waiter) -> BrokerSocket:
    deadline = time.monotonic() + CONNECT_TIMEOUT_S
    connection = socket.socket(family, socket.SOCK_STREAM)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _raise_for(connection.connect_ex(address))
        _wait(connection, waiter, deadline, write=True)
        _raise_for(connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
        broker = BrokerSocket(connection, channel)
        if channel is not None:
            _agree(broker, channel, waiter, deadline)
    except BaseException:
        connection.close()
        raise
    return broker


def _agree(broker: BrokerSocket, channel: SecureChannel, waiter: Waiter, deadline: float) -> None:
    """Completes the handshake of TLS."""
    broker.greet()
    while not channel.is_ready:
        _wait(broker.connection, waiter, deadline, read=True, write=broker.unsent > 0)
        broker.flush()
        if broker.receive_from_broker(READ_BYTES):
            raise ConnectionError("the broker sent something before it was asked")
        if isinstance(broker.error, OSError):
            raise broker.error


def _raise_for(code: int) -> None:
    if code not in _UNDER_WAY:
        raise OSError(code, error_text(code))


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
        raise TimeoutError(f"no answer within {CONNECT_TIMEOUT_S:g} s")
