"""Sends lines to syslog, or to the journal of systemd.

Syslog is RFC 5424 over UDP (RFC 5426), TCP (RFC 6587) or a Unix socket.
`logging.handlers.SysLogHandler` writes the older format, does not frame messages over TCP, and does
not connect again. The journal gets one datagram for each entry, by its native protocol.
"""

from __future__ import annotations

import errno
import os
import socket
import sys
from abc import ABC, abstractmethod
from array import array
from typing import Any, Literal

import msgspec

TIMEOUT_S = 5.0
"""Seconds for a connection, and for a message that the receiver does not take."""

LOCAL0, NOTICE = 16, 5
PRIORITY = LOCAL0 << 3 | NOTICE
"""Facility and severity of all messages. Receivers select them by their application."""

JOURNAL_PATH = "/run/systemd/journal/socket"
JOURNAL_FIELDS = b"SYSLOG_IDENTIFIER=holdfast-audit\nPRIORITY=5\nMESSAGE="
"""5 is notice. A line has no line feed inside, so the simple form of a field suffices."""


class _SocketReceiver(ABC):
    """Connects with the first line, and again after an error."""

    reports_late = False
    _socket: socket.socket | None = None

    def send(self, line: bytes) -> None:
        """Sends a line as one message. Raises `OSError`."""
        try:
            self._transmit(self._connected(), line)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Closes the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connected(self) -> socket.socket:
        if self._socket is None:
            self._socket = self._connect()
            self._socket.settimeout(TIMEOUT_S)
        return self._socket

    @abstractmethod
    def _connect(self) -> socket.socket:
        """Returns a new connection."""

    @abstractmethod
    def _transmit(self, connection: socket.socket, line: bytes) -> None:
        """Sends a line."""


class Syslog(_SocketReceiver):
    """A syslog receiver."""

    def __init__(
        self,
        transport: Literal["udp", "tcp", "unix"],
        target: tuple[str, int] | str,
    ) -> None:
        """`target`: host and port, or the path of a Unix socket."""
        self._transport = transport
        self.reports_late = transport != "unix"
        self._target = target

    def _transmit(self, connection: socket.socket, line: bytes) -> None:
        time = msgspec.json.decode(line)["time"]
        host = socket.gethostname() or "-"
        head = f"<{PRIORITY}>1 {time} {host} holdfast {os.getpid()} audit - "
        message = head.encode() + line
        if self._transport == "tcp":
            message = b"%d %b" % (len(message), message)
        connection.sendall(message)

    def _connected(self) -> socket.socket:
        if self._socket is not None and self._transport == "tcp" and _has_ended(self._socket):
            self.close()
        return super()._connected()

    def _connect(self) -> socket.socket:
        if isinstance(self._target, str):
            return unix_datagrams(self._target)
        if self._transport == "tcp":
            return socket.create_connection(self._target, TIMEOUT_S)
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
        connection.settimeout(TIMEOUT_S)
        return False
    except OSError:
        return True
    return True


def datagrams(family: int, address: Any) -> socket.socket:
    """A socket that sends datagrams to an address. Raises `OSError`."""
    made = socket.socket(family, socket.SOCK_DGRAM)
    try:
        made.connect(address)
    except OSError:
        made.close()
        raise
    return made


def unix_datagrams(path: str) -> socket.socket:
    """A socket that sends datagrams to a Unix socket. Raises `OSError`."""
    if sys.platform == "win32":
        raise OSError("this system has no Unix sockets for datagrams")
    return datagrams(socket.AF_UNIX, path)


class Journal(_SocketReceiver):
    """The journal of this machine."""

    def __init__(self, path: str = JOURNAL_PATH) -> None:
        self._path = path

    def _transmit(self, connection: socket.socket, line: bytes) -> None:
        entry = JOURNAL_FIELDS + line + b"\n"
        try:
            connection.send(entry)
        except OSError as error:
            if error.errno != errno.EMSGSIZE:
                raise
            _send_in_file(connection, entry)

    def _connect(self) -> socket.socket:
        return unix_datagrams(self._path)


if sys.platform == "linux":
    import fcntl

    SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL

    def _send_in_file(connection: socket.socket, entry: bytes) -> None:
        """Sends an entry that is too large for a datagram: in sealed memory."""
        descriptor = os.memfd_create("holdfast-audit", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        with os.fdopen(descriptor, "wb", buffering=0) as file:
            file.write(entry)
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, SEALS)
            right = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array("i", [descriptor]))
            connection.sendmsg([], [right])

else:

    def _send_in_file(_connection: socket.socket, _entry: bytes) -> None:
        raise OSError(errno.EMSGSIZE, "the entry is too large for a datagram")
