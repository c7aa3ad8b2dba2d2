"""Tasks of asyncio: their beginning and end, waiting with a limit, the heartbeat of their loop."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakValueDictionary

from holdfast.runtime.heartbeat import PERIOD_S

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterable

    from holdfast.runtime.heartbeat import Heartbeat

CANCEL_INTERVAL_S = 2.0
"""Seconds after which a task that has not ended is cancelled again."""


Result = TypeVar("Result")


def begin(work: Coroutine[Any, Any, Result], among: set[asyncio.Task[Result]]) -> None:
    """Runs work as a task, which is `among` others until it ends: asyncio keeps no task alive."""
    task = asyncio.create_task(work)
    among.add(task)
    task.add_done_callback(among.discard)


def call_soon(
    loop: asyncio.AbstractEventLoop, call: Callable[..., object], *arguments: object
) -> None:
    """Calls a function in an event loop, unless that is closed already. Thread-safe."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(call, *arguments)


def check() -> None:
    """Raises `CancelledError` if this task has lost a cancellation, see `end`.

    A loop that calls it ends without a second cancellation.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


async def end(tasks: Iterable[asyncio.Task[Any]]) -> None:
    """Cancels tasks, and waits until they have ended. Ignores their errors.

    Until Python 3.12, `asyncio.wait_for`, which nats-py uses, loses a cancellation that comes
    together with the result.
    """
    left = set(tasks)
    while left:
        for task in left:
            task.cancel()
        done, left = await asyncio.wait(left, timeout=CANCEL_INTERVAL_S)
        for task in done:
            if not task.cancelled():
                task.exception()  # Marks it retrieved.


async def within(seconds: float | None, step: Awaitable[object]) -> None:
    """Waits until a step is done, or these seconds have passed; `None`: without a limit."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await step


class Places:
    """Places by key: up to `most` tasks have one of the same key at a time, the others wait."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._used: WeakValueDictionary[object, asyncio.Semaphore] = WeakValueDictionary()

    def of(self, key: object) -> asyncio.Semaphore:
        """Returns the places of a key."""
        places = self._used.get(key)
        if places is None:
            places = self._used[key] = asyncio.Semaphore(self._most)
        return places


@contextlib.asynccontextmanager
async def beating(heartbeat: Heartbeat) -> AsyncIterator[None]:
    """Beats in this event loop until the block ends."""
    task = asyncio.create_task(_keep(heartbeat))
    try:
        yield
    finally:
        task.cancel()


async def _keep(heartbeat: Heartbeat) -> None:
    while True:
        heartbeat.beat()
        await asyncio.sleep(PERIOD_S)
