"""Ends tasks of asyncio."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

CANCEL_INTERVAL_S = 2.0
"""Seconds after which a task that has not ended is cancelled again."""


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
