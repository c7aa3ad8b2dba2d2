"""Sends lines to syslog: RFC 5424 over UDP (RFC 5426), TCP (RFC 6587) or a Unix socket.

`logging.handlers.SysLogHandler` writes the older format, does not frame messages over TCP, and does
not connect again.
"""

from __future__ import annotations

import os
import socket
from logging.handlers import SysLogHandler
from typing import Literal

import msgspec

from holdfast.audit.datagrams import datagrams, unix_datagrams

TIMEOUT = 5.0
"""Seconds for a connection, and for a message that the receiver does not take."""

NOTICE = SysLogHandler.LOG_NOTICE


class Syslog:
    """A syslog receiver. Connects with the first message, and again after an error."""

    def __init__(
        self,
        transport: Literal["udp", "tcp", "unix"],
        target: tuple[str, int] | str,
        facility: str,
    ) -> None:
        """`target`: host and port, or the path of a Unix socket."""
        self._transport = transport
        self._target = target
        self._priority = SysLogHandler.facility_names[facility] << 3 | NOTICE
        self._socket: socket.socket | None = None

    def send(self, line: bytes) -> None:
        """Sends a line as one message. Raises `OSError`."""
        try:
            connection = self._connected()
            message = self._message(line)
            if self._transport == "tcp":
                message = b"%d %b" % (len(message), message)
            connection.sendall(message)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Closes the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _message(self, line: bytes) -> bytes:
        time = msgspec.json.decode(line)["time"]
        host = socket.gethostname() or "-"
        return f"<{self._priority}>1 {time} {host} holdfast {os.getpid()} audit - ".encode() + line

    def _connected(self) -> socket.socket:
        if self._socket is not None and self._transport == "tcp" and _has_ended(self._socket):
            self.close()
        if self._socket is None:
            self._socket = self._connect()
            self._socket.settimeout(TIMEOUT)
        return self._socket

    def _connect(self) -> socket.socket:
        if isinstance(self._target, str):
            return unix_datagrams(self._target)
        if self._transport == "tcp":
            return socket.create_connection(self._target, TIMEOUT)
        found = socket.getaddrinfo(*self._target, type=socket.SOCK_DGRAM)
        family, _, _, _, address = found[0]
        return datagrams(family, address)


def _has_ended(connection: socket.socket) -> bool:
    """Whether the receiver has closed a connection. What it sends is of no interest."""
    connection.settimeout(0)
    try:
        while connection.recv(4096):
            pass
    except BlockingIOError:
        connection.settimeout(TIMEOUT)
        return False
    return True
