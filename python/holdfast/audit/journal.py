"""Sends lines to the journal of systemd, by its native protocol: one datagram for each entry."""

from __future__ import annotations

import errno
import os
import socket
import sys
from array import array

from holdfast.audit.datagrams import unix_datagrams

PATH = "/run/systemd/journal/socket"
TIMEOUT = 5.0

FIELDS = b"SYSLOG_IDENTIFIER=holdfast-audit\nPRIORITY=5\nMESSAGE="
"""5 is notice. A line has no line feed inside, so the simple form of a field suffices."""


class Journal:
    """The journal of this machine. Connects with the first entry, and again after an error."""

    def __init__(self, path: str = PATH) -> None:
        self._path = path
        self._socket: socket.socket | None = None

    def send(self, line: bytes) -> None:
        """Sends a line as one entry. Raises `OSError`."""
        entry = FIELDS + line + b"\n"
        try:
            connection = self._connected()
            try:
                connection.send(entry)
            except OSError as error:
                if error.errno != errno.EMSGSIZE:
                    raise
                _send_in_file(connection, entry)
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
            self._socket = unix_datagrams(self._path)
            self._socket.settimeout(TIMEOUT)
        return self._socket


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
