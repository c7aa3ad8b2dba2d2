"""A thread for work that takes long, beside an event loop."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import Future
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

Result = TypeVar("Result")


class OwnThread:
    """Carries out work in a thread of its own, one after the other.

    An event loop or an interpreter that ends does not wait for it, as for `asyncio.to_thread`. The
    thread ends with this object.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._queue: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self.ended: Future[None] = Future()
        """Done when a thread that was started has ended."""
        # Nobody can cancel it: not even a task that waits for it, and is cancelled.
        self.ended.set_running_or_notify_cancel()

    def start(self) -> None:
        """Starts the thread before its first work.

        Raises `RuntimeError` if the interpreter ends and starts no more threads.
        """
        with self._lock:
            if self._thread is None:
                # Without a reference to this object, which its owner may forget.
                thread = threading.Thread(
                    target=_run, args=(self._queue, self.ended), name=self._name, daemon=True
                )
                thread.start()
                self._thread = thread

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Returns the result of the work as a future. Raises `RuntimeError` as `start`."""
        self.start()
        ended: Future[Result] = Future()
        self._queue.put((ended, work))
        return ended

    async def call(self, work: Callable[[], Result]) -> Result:
        """Returns the result of the work. If this is cancelled, work that waits is dropped."""
        return await asyncio.wrap_future(self.submit(work))

    def end(self) -> None:
        """Ends the thread after the work that waits."""
        self._queue.put(None)

    def __del__(self) -> None:
        self.end()


def _run(
    queue: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None], end: Future[None]
) -> None:
    while (item := queue.get()) is not None:
        ended, work = item
        if ended.set_running_or_notify_cancel():
            try:
                ended.set_result(work())
            except BaseException as error:
                ended.set_exception(error)
        del item, ended, work
    end.set_result(None)
