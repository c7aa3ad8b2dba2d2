"""A request to stop a service: an adapter, the scanner, the gateway or an HTTP host."""

from __future__ import annotations

import threading
import time
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Stop:
    """A request to stop a service. Thread-safe."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._lock = threading.Lock()
        self._then: list[Callable[[], object]] = []
        self.at = inf
        """When the stop was requested, by `time.monotonic`."""

    def set(self) -> None:
        """Requests the stop."""
        with self._lock:
            self.at = min(self.at, time.monotonic())
            self._event.set()
            then, self._then = self._then, []
        for callback in then:
            callback()

    def is_set(self) -> bool:
        """Returns whether a stop was requested."""
        return self._event.is_set()

    def wait(self, seconds: float | None = None) -> bool:
        """Waits at most `seconds` for a stop request. Returns whether there was one."""
        return self._event.wait(seconds)

    def then(self, callback: Callable[[], object]) -> None:
        """Calls `callback` when a stop is requested; immediately if it already was."""
        with self._lock:
            if not self._event.is_set():
                self._then.append(callback)
                return
        callback()

    def forget(self, callback: Callable[[], object]) -> None:
        """Does not call `callback` any more."""
        with self._lock:
            if callback in self._then:
                self._then.remove(callback)
