"""Detects that a thread or event loop did not run: its process was stopped, or its machine.

Also detects that the wall clock was set.
"""

from __future__ import annotations

import logging
import math
import sys
import time

from holdfast.events import log_lines

STANDSTILL_S = 2.0
"""Seconds between two looks that are a standstill. As long as a node of a fleet may use a device
after it has renewed its lease."""

MAX_LOOK_INTERVAL_S = STANDSTILL_S / 4
"""Seconds between two looks, at most, while the thread or event loop runs."""


def now() -> float:
    """Returns seconds of a clock that goes on while the machine is suspended, if it has one."""
    if sys.platform == "linux":
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


class Standstill:
    """The last standstill of a thread or event loop. Not thread-safe."""

    def __init__(self, part: str, long_s: float = STANDSTILL_S) -> None:
        """`part` is what the log calls it. `long_s` is the shortest standstill."""
        self._part = part
        self._long_s = long_s
        self.look_interval_s = min(long_s / 4, MAX_LOOK_INTERVAL_S)
        self._looked: float | None = None
        self.ended = -math.inf
        """When the last standstill was detected, by `now`."""
        self.lasted = 0.0
        """How many seconds it lasted."""

    def look(self) -> None:
        """Detects a standstill.

        Call it every `look_interval_s`, and before what may be too late.
        """
        before, self._looked = self._looked, now()
        if before is not None and self._looked - before > self._long_s:
            self.ended, self.lasted = self._looked, self._looked - before
            seconds = round(self.lasted, 1)
            log_lines.write(logging.WARNING, "stood_still", part=self._part, seconds=seconds)


MIN_STEP_S = 2.0
"""The shortest step of the wall clock, in seconds. Without steps, NTP corrects less than 0.001 s in
a second."""

_MAX_READING_S = 0.1
"""Seconds in which both clocks must be read, to be compared."""


class WallClock:
    """Detects steps of the wall clock, by a clock that nobody sets. Not thread-safe."""

    def __init__(self) -> None:
        self._ahead = self._compare()

    def look(self) -> float | None:
        """Logs a step since the last look. Returns its seconds, negative if set back, or `None`."""
        before, ahead = self._ahead, self._compare()
        self._ahead = before if ahead is None else ahead
        if before is None or ahead is None or abs(ahead - before) < MIN_STEP_S:
            return None
        step = round(ahead - before, 3)
        log_lines.write(logging.WARNING, "clock_stepped", step=step)
        return step

    @staticmethod
    def _compare() -> float | None:
        """How far the wall clock is ahead; `None` if the process stopped meanwhile."""
        began, wall, ended = now(), time.time(), now()
        return wall - ended if ended - began < _MAX_READING_S else None
