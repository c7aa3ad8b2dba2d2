"""`WriteCallback`: calls a function for the writes to a memory."""

from __future__ import annotations

import atexit
import sys
import threading
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast._core import WriteQueue
    from holdfast.types import Area

    Written = Callable[[Area, int, list[int]], object]

WAIT_S = 3600.0
"""Seconds of one wait for a write. It ends when the queue is closed."""

CALLBACK_END_TIMEOUT_S = 1.0
"""Seconds to wait for a callback that runs while it is closed."""


class WriteCallback:
    """A callback for the writes to a memory, until `close`. Made by `Memory.on_write`."""

    def __init__(self, queue: WriteQueue, callback: Written) -> None:
        self._queue = queue
        self._callback = callback
        self._thread = threading.Thread(target=self._run, name="holdfast-on-write", daemon=True)
        # A thread that waits in native code must have ended before the interpreter does.
        atexit.register(self.close)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """How many writes were dropped because the callback is too slow."""
        return self._queue.dropped

    def close(self) -> None:
        """Ends the calls, and waits for one that runs for up to a second. Writes that wait for the
        callback are dropped. Can be called from any thread, also from the callback.
        """
        self._queue.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(CALLBACK_END_TIMEOUT_S)

    def _run(self) -> None:
        while not self._queue.is_closed:
            written = self._queue.next(WAIT_S)
            if written is None:
                continue
            try:
                self._callback(*written)
            except Exception:
                thrown = threading.ExceptHookArgs((*sys.exc_info(), self._thread))
                threading.excepthook(thrown)
        atexit.unregister(self.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
