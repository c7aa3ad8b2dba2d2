"""Waits for a socket. A stop ends the wait immediately."""

from __future__ import annotations

import contextlib
import selectors
import socket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Self

    from holdfast.runtime.stop import Stop

_Selector: type[selectors.BaseSelector] = getattr(
    selectors, "PollSelector", selectors.SelectSelector
)
"""poll() where available, because select() fails for descriptors above 1023."""


class Ended(Exception):
    """The adapter must end."""


class Waiter:
    """Waits for one socket at a time, in one thread. Raises `Ended` as soon as `stop` is set."""

    def __init__(self, stop: Stop) -> None:
        self._stop = stop
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_writer.setblocking(False)
        self._wake_reader.setblocking(False)
        stop.then(self.wake)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the use of this waiter."""
        self._stop.forget(self.wake)
        self._wake_reader.close()
        self._wake_writer.close()

    def wake(self) -> None:
        """Ends the current or the next wait. Thread-safe."""
        with contextlib.suppress(OSError):
            self._wake_writer.send(b"\0")

    def check(self) -> None:
        """Raises `Ended` if `stop` is set."""
        if self._stop.is_set():
            raise Ended

    def wait(
        self, for_this: socket.socket, *, read: bool, write: bool, seconds: float
    ) -> tuple[bool, bool]:
        """Waits at most `seconds`. Returns whether the socket is readable, and writable."""
        self.check()
        interest = selectors.EVENT_READ * read | selectors.EVENT_WRITE * write
        with _Selector() as selector:
            selector.register(self._wake_reader, selectors.EVENT_READ)
            if interest:
                selector.register(for_this, interest)
            ready = {key.fileobj: events for key, events in selector.select(max(0.0, seconds))}
        self.check()
        if self._wake_reader in ready:
            with contextlib.suppress(BlockingIOError):
                self._wake_reader.recv(4096)
        events = ready.get(for_this, 0)
        return bool(events & selectors.EVENT_READ), bool(events & selectors.EVENT_WRITE)
