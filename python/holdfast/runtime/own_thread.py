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

    An event loop or an interpreter that ends does not wait for it, as for `asyncio.to_thread`.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._queue: SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = SimpleQueue()

    async def call(self, work: Callable[[], Result]) -> Result:
        """Returns the result of the work. If this is cancelled, work that waits is dropped."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
        ended: Future[Result] = Future()
        self._queue.put((ended, work))
        return await asyncio.wrap_future(ended)

    def _run(self) -> None:
        while True:
            ended, work = self._queue.get()
            if ended.set_running_or_notify_cancel():
                try:
                    ended.set_result(work())
                except BaseException as error:
                    ended.set_exception(error)
            del ended, work
