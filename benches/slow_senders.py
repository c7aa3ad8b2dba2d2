"""Opens many connections to a server over HTTP, and keeps them until its standard input ends.

It prints `open`, when all are, and how many were closed by the server so far, as soon as it is
asked with a line. Kind `idle` sends one request on each connection, and then nothing; `slow` sends
one byte by byte, in turns, `RATE` bytes a second. A connection that is closed is opened again.
"""

from __future__ import annotations

import contextlib
import itertools
import resource
import select
import socket
import sys
import time

RATE = 2000
SOURCES = 16
SOURCE_PLACES = itertools.cycle(f"127.0.1.{number}" for number in range(1, SOURCES + 1))
REQUEST = b"GET /api/v1/health HTTP/1.1\r\nHost: 127.0.0.1\r\n"
"""Without the empty line at its end."""


class Senders:
    """The connections."""

    def __init__(self, address: str, kind: str) -> None:
        host, _, port = address.rpartition(":")
        self._address = (host, int(port))
        self._is_idle = kind == "idle"
        self._open: list[tuple[socket.socket, int]] = []
        self.closed = 0

    def add(self) -> None:
        """Opens one more."""
        self._open.append((self._connected(), 1))

    def _connected(self) -> socket.socket:
        connection = socket.create_connection(self._address, 10, (next(SOURCE_PLACES), 0))
        with contextlib.suppress(ConnectionError):
            if self._is_idle:
                connection.sendall(REQUEST + b"\r\n")
                connection.recv(4096)
            else:
                connection.setblocking(False)
                connection.send(REQUEST[:1])
        return connection

    def drip(self) -> None:
        """Sends a byte on each connection in turn; then asks whether to go on."""
        due = time.monotonic()
        for at in itertools.cycle(range(len(self._open))):
            if at % 100 == 0:
                due += 100 / RATE
                if not asked(self.closed, max(0.0, due - time.monotonic())):
                    return
            connection, sent = self._open[at]
            try:
                # A long header, that never ends.
                connection.send(REQUEST[sent : sent + 1] or b"x")
                self._open[at] = connection, sent + 1
            except OSError:
                self.closed += 1
                connection.close()
                self._open[at] = self._connected(), 1


def asked(closed: int, wait: float) -> bool:
    """Answers a question that comes within a time. Returns whether standard input is open."""
    if select.select([sys.stdin], [], [], wait)[0]:
        if not sys.stdin.readline():
            return False
        print(closed, flush=True)
    return True


def main() -> None:
    """Runs until the end of standard input."""
    address, kind, count = sys.argv[1:]
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    senders = Senders(address, kind)
    for _ in range(int(count)):
        senders.add()
    print("open", flush=True)
    if kind == "idle":
        while asked(0, 60.0):
            pass
    else:
        senders.drip()


if __name__ == "__main__":
    main()
