"""A schedule for repeated work that does not drift."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def ticks(
    every: float, times: int | None = None, wait: Callable[[float], object] = time.sleep
) -> Iterator[int]:
    """Yields now and at every multiple of `every` seconds from now, `times` times or forever.

    Skips ticks that pass while the caller is busy. `wait` waits for some seconds.
    """
    start = time.monotonic()
    tick = done = 0
    while True:
        yield done
        done += 1
        if done == times:
            return
        tick = max(tick, int((time.monotonic() - start) / every)) + 1
        while (left := start + tick * every - time.monotonic()) > 0:
            wait(left)
