"""`WriteCallback`: calls a function for the writes to a memory."""

from __future__ import annotations

import atexit
import inspect
import os
import threading
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast._core import WriteQueue

    Written = Callable[[str, int, list[int]], object]

WAIT_S = 3600.0
"""Seconds of one wait for a write. It ends when the queue is closed."""

CALLBACK_END_TIMEOUT_S = 1.0
"""Seconds to wait for a callback that runs while it is closed."""


class WriteCallback:
    """A callback for the writes to a memory, until `close`. Made by `Memory.on_write`."""

    def __init__(self, queue: WriteQueue, callback: Written) -> None:
        if _is_async(callback):
            queue.close()
            raise TypeError(f"callback is {callback!r}, an async def, allowed: a plain function")
        self._queue = queue
        self._callback = callback
        self._process = os.getpid()
        self._thread = threading.Thread(target=self._run, name="holdfast-on-write", daemon=True)
        # A thread that waits in native code must have ended before the interpreter does.
        atexit.register(self.close)
        try:
            self._thread.start()
        except RuntimeError:  # The system has no more threads.
            atexit.unregister(self.close)
            queue.close()
            raise

    @property
    def dropped(self) -> int:
        """How many writes were dropped because the callback is too slow; 0 in a forked child."""
        return 0 if self._is_in_child else self._queue.dropped

    def close(self) -> None:
        """Ends the calls, and waits for one that runs for up to a second. Writes that wait for the
        callback are dropped. Can be called from any thread, also from the callback. Does nothing in
        a forked child, which has no calls.
        """
        if self._is_in_child:
            return
        self._queue.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(CALLBACK_END_TIMEOUT_S)

    @property
    def _is_in_child(self) -> bool:
        """Whether this is a copy in a forked child: a thread of the parent may hold the lock of the
        queue, and does not release it here.
        """
        return os.getpid() != self._process

    def _run(self) -> None:
        while not self._queue.is_closed:
            written = self._queue.next(WAIT_S)
            if written is None:
                continue
            try:
                self._callback(*written)
            except BaseException as error:
                self._report(error)
        atexit.unregister(self.close)

    def _report(self, error: BaseException) -> None:
        if isinstance(error, SystemExit):  # The usual hook is silent about it.
            exits, error = error, RuntimeError(f"{self._callback!r} raised {error!r}")
            error.__cause__ = exits
        thrown = (type(error), error, error.__traceback__, self._thread)
        threading.excepthook(threading.ExceptHookArgs(thrown))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _is_async(callback: Written) -> bool:
    """Whether a call of this makes a coroutine, which nobody would run."""
    called = (callback, type(callback).__call__)
    return any(inspect.iscoroutinefunction(each) for each in called)
