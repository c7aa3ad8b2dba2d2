"""A proxy in front of a server, which disturbs its connections."""

from __future__ import annotations

import contextlib
import socket
import threading

from support import wire


class Proxy:
    """Passes connections on to a port. It can cut them while the server keeps running."""

    def __init__(self, port: int, scheme: str = "mqtt") -> None:
        self._to = port
        self._is_down = False
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"{scheme}://127.0.0.1:{self._server.getsockname()[1]}"
        self._lock = threading.Lock()
        self._open: list[socket.socket] = []
        self.swallows = False
        """Whether it reads from clients, but forwards nothing."""
        self._flows = threading.Event()
        self._flows.set()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def _accept(self) -> None:
        while True:
            try:
                near = self._server.accept()[0]
            except OSError:
                return
            if self._is_down:
                near.close()
                continue
            try:
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                near.close()
                continue
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._open += [near, far]
            for ends in ((near, far), (far, near)):
                thread = threading.Thread(target=self._pump, args=ends)
                self._threads.append(thread)
                thread.start()

    def _pump(self, here: socket.socket, there: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while piece := here.recv(65536):
                self._flows.wait()
                if not self.swallows:
                    there.sendall(piece)
        for end in (here, there):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def down(self) -> None:
        """Closes every connection, and each new one, until `up`."""
        self._is_down = True
        self.cut()

    def up(self) -> None:
        """Lets connections through again."""
        self._is_down = False

    def hold(self) -> None:
        """Leaves connections open, and forwards nothing until `go_on`: then all that has come."""
        self._flows.clear()

    def go_on(self) -> None:
        """Forwards again."""
        self._flows.set()

    def cut(self) -> None:
        """Closes every connection."""
        with self._lock:
            ends = list(self._open)
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._threads[0].join(wire.DEADLINE)
        self._server.close()
        self.cut()
        self._flows.set()
        for thread in self._threads:
            thread.join(wire.DEADLINE)
        for end in self._open:
            end.close()
