"""Ends what would abort a program that ends: when all its threads have ended but daemons.

Up to Python 3.13, the interpreter ends a daemon thread wherever it runs Python code. Where the
native core has called that code, as for every reply, this would abort the process. So the threads
of clients end, and the event loops of daemon threads sleep.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import time
from threading import Event
from typing import TYPE_CHECKING, Protocol
from weakref import WeakSet

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop
    from concurrent.futures import Future

SLEEP_S = 1.0
"""Longer than the rest of the end takes. Not for ever: a later hook may wait for the loop."""


class Ending(Protocol):
    """A daemon thread with native calls."""

    @property
    def ended(self) -> Future[None]:
        """Done when the thread has ended."""

    def close(self) -> None:
        """Lets the thread end, and what it does."""


_ends = Event()
_threaded: WeakSet[Ending] = WeakSet()
_loops: WeakSet[AbstractEventLoop] = WeakSet()


def end_at_exit(threaded: Ending) -> None:
    """Ends it before the program ends. Raises `RuntimeError` if it ends already."""
    _threaded.add(threaded)
    if _ends.is_set():  # After the addition: `_end` sees it, or this sees that the end has begun.
        raise RuntimeError("the program ends: a client can't start its thread")


def sleep_at_end(loop: AbstractEventLoop) -> None:
    """Lets a loop sleep if it still runs when the program ends."""
    _loops.add(loop)


def _sleep(sleeps: Event) -> None:
    sleeps.set()
    time.sleep(SLEEP_S)


def _end() -> None:
    _ends.set()
    threaded = list(_threaded)
    for each in threaded:
        each.close()
    for each in threaded:
        each.ended.result()
    if sys.version_info < (3, 14):
        _let_loops_sleep()


def _let_loops_sleep() -> None:
    for loop in list(_loops):
        if loop.is_running():
            sleeps = Event()
            with contextlib.suppress(RuntimeError):  # It may be closed meanwhile.
                loop.call_soon_threadsafe(_sleep, sleeps)
                sleeps.wait(SLEEP_S)


def _forget() -> None:
    """A child does not have the other threads."""
    _threaded.clear()
    _loops.clear()


atexit.register(_end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
