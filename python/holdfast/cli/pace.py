"""Doing something again and again, at times that do not drift."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def ticks(
    every: float, times: int | None = None, wait: Callable[[float], object] = time.sleep
) -> Iterator[int]:
    """Comes back now and after every multiple of `every` seconds from now; `times`, or for ever.

    What was missed because the caller took longer is left out. `wait` lets a time pass.
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
