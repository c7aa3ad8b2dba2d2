"""Ends what would keep or abort a program that ends.

The interpreter waits for the threads of clients: their calls end.

The event loops of daemon threads sleep. Up to Python 3.13, the interpreter ends such a thread
wherever it runs Python code. Where the native core has called that code, as for every reply, this
would abort the process.
"""

from __future__ import annotations

import atexit
import concurrent.futures.thread  # noqa: F401 - registers its hook before that of this module
import contextlib
import os
import sys
import threading
import time
from threading import Event
from typing import TYPE_CHECKING, Protocol
from weakref import WeakSet

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

SLEEP_S = 1.0
"""Longer than the rest of the end takes. Not for ever: a later hook may wait for the loop."""


class Ending(Protocol):
    """What has a thread that the interpreter waits for."""

    def end(self) -> None:
        """Ends the thread, and what it does."""


_ends = Event()
_threaded: WeakSet[Ending] = WeakSet()
_loops: WeakSet[AbstractEventLoop] = WeakSet()


def end_at_exit(threaded: Ending) -> None:
    """Ends it if the program ends before its owner has closed it."""
    _threaded.add(threaded)


def sleep_at_end(loop: AbstractEventLoop) -> None:
    """Lets a loop sleep if it still runs when the program ends."""
    _loops.add(loop)


def has_begun() -> bool:
    """Whether the program ends, so that executors may take nothing more."""
    return _ends.is_set()


def _sleep(sleeps: Event) -> None:
    sleeps.set()
    time.sleep(SLEEP_S)


def _end() -> None:
    for loop in list(_loops):
        if loop.is_running():
            sleeps = Event()
            with contextlib.suppress(RuntimeError):  # It may be closed meanwhile.
                loop.call_soon_threadsafe(_sleep, sleeps)
                sleeps.wait(SLEEP_S)


def _end_threads() -> None:
    _ends.set()
    for threaded in list(_threaded):
        threaded.end()


# The hooks of `atexit` run after the interpreter has waited for all threads. These run before, the
# last first: that of `concurrent.futures` waits for its threads.
threading._register_atexit(_end_threads)  # type: ignore[attr-defined]
if sys.version_info < (3, 14):
    atexit.register(_end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_loops.clear)  # A child does not have the other threads.
