"""Opening a connection to a broker, TCP or TLS; a stop ends every step of it."""

from __future__ import annotations

import errno
import os
import socket
import ssl
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from holdfast.adapters.mqtt.waiting import Waiter
    from holdfast.config import BrokerTlsConfig

CONNECT_TIMEOUT = 10.0
"""Seconds that one address of the broker has to accept the connection, and TLS to be agreed on."""

_UNDER_WAY = {0, errno.EINPROGRESS, errno.EWOULDBLOCK}


def tls_context(files: BrokerTlsConfig | None) -> ssl.SSLContext:
    """Checks certificate and host name; the files are read now, so a renewed one is taken.

    Raises `OSError` for a file that can't be used.
    """
    context = ssl.create_default_context(
        cafile=None if files is None or files.ca_file is None else str(files.ca_file)
    )
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if files is not None and files.cert_file is not None:
        # A password is given lest OpenSSL ask for one on the terminal.
        context.load_cert_chain(files.cert_file, files.key_file, password="")
    return context


def dial(host: str, port: int, context: ssl.SSLContext | None, waiter: Waiter) -> socket.socket:
    """A connection that doesn't block, to the first address that takes it.

    Raises `OSError` when none does, and `Ended`.
    """
    failure = OSError(f"{host} has no address")
    for family, address in _addresses(host, port, waiter):
        try:
            return _open(family, address, host, context, waiter)
        except OSError as error:
            failure = error
    raise failure


def _addresses(host: str, port: int, waiter: Waiter) -> list[tuple[int, Any]]:
    """Asks in a thread of its own, because nothing can interrupt the system's resolver."""
    found: list[tuple[int, Any]] = []
    failures: list[OSError] = []
    done = threading.Event()

    def ask() -> None:
        try:
            for family, _, _, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
                found.append((family, address))
        except OSError as error:
            failures.append(error)
        except UnicodeError:
            failures.append(OSError(f"{host} can't be a host name"))
        finally:
            done.set()

    threading.Thread(target=ask, name="holdfast-mqtt-resolver", daemon=True).start()
    while not done.wait(0.1):
        waiter.check()
    if failures:
        raise failures[0]
    return found


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
