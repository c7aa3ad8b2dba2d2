"""Whether the threads of a running appliance still get to their work."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

from holdfast.events import log_lines
from holdfast.runtime.processor_time import cpu_time

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.types import ThreadHeartbeat

STALLED_S = 10.0
"""Seconds without a heartbeat after which a thread is stalled."""

MAIN = "main"
"""The name of the thread that calls `check`, among those that are stalled."""

MAIN_STALLED_S = 30.0
"""Seconds without a check after which that thread is stalled. A reload, which waits for adapters to
stop, must be possible in this time."""


class Liveness:
    """Watches heartbeats. `check` is for one thread; all else is thread-safe."""

    def __init__(self, heartbeats: Callable[[], Sequence[ThreadHeartbeat]]) -> None:
        self._heartbeats = heartbeats
        self._checked = time.monotonic()
        self._stalled: set[str] = set()

    def stalled(self) -> list[str]:
        """Returns the threads that were stalled at the last check; `MAIN` if that is long ago."""
        unchecked = time.monotonic() - self._checked
        if unchecked > MAIN_STALLED_S:
            # A suspended process holds up all threads. Those without a loop have the age 0.
            ages = [age for _, age, _ in self._heartbeats() if age]
            if unchecked - min(ages, default=0.0) > MAIN_STALLED_S:
                return sorted({*self._stalled, MAIN})
        return sorted(self._stalled)

    def check(self) -> None:
        """Logs threads that have stalled or are back. Call it about once a second."""
        now = time.monotonic()
        # A suspended process holds up this thread too. Only what exceeds that is a stall.
        limit = STALLED_S + now - self._checked
        self._checked = now
        ages = {thread: age for thread, age, _ in self._heartbeats()}
        stalled = {
            thread
            for thread, age in ages.items()
            if age > (STALLED_S if thread in self._stalled else limit)
        }
        for thread in sorted(stalled - self._stalled):
            age = round(ages[thread], 1)
            log_lines.write(logging.ERROR, "thread_stalled", thread=thread, heartbeat_age=age)
        for thread in sorted(self._stalled - stalled):
            log_lines.write(logging.INFO, "thread_back", thread=thread)
        self._stalled = stalled

    def threads(self) -> dict[str, dict[str, Any]]:
        """Returns the age of the heartbeat and the processor time of each thread, in seconds."""
        return {
            thread: {"heartbeat_age": round(age, 3), "cpu": cpu_time(number)}
            for thread, age, number in self._heartbeats()
        }
