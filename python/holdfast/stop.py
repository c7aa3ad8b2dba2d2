"""How a service is told to end: an adapter, the scanner, the gateway, an HTTP host."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Stop:
    """Says that a service is to end. From any thread."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._lock = threading.Lock()
        self._then: list[Callable[[], object]] = []

    def set(self) -> None:
        """Tells the service."""
        with self._lock:
            self._event.set()
            then, self._then = self._then, []
        for callback in then:
            callback()

    def is_set(self) -> bool:
        """Whether the service is to end."""
        return self._event.is_set()

    def wait(self, seconds: float | None = None) -> bool:
        """Waits until the service is to end, at most `seconds`; whether it is."""
        return self._event.wait(seconds)

    def then(self, callback: Callable[[], object]) -> None:
        """Calls `callback` when the service is to end: at once, when it is already."""
        with self._lock:
            if not self._event.is_set():
                self._then.append(callback)
                return
        callback()
