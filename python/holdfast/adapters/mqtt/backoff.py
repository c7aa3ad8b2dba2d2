"""How long to wait before the next attempt to reach the broker."""

from __future__ import annotations

import random

FIRST_PAUSE = 1.0
MAX_PAUSE = 60.0
"""Seconds: doubled with each failure, up to the longest."""

JITTER = 0.25
"""The part of a pause that is left to chance, so that clients don't all come at once."""

PROVEN = 10.0
"""Seconds after which a connection that held is held to be good: the pauses begin anew."""


class Backoff:
    """The pauses between attempts."""

    def __init__(self) -> None:
        self._next = FIRST_PAUSE

    def pause(self, held: float) -> float:
        """Seconds to wait, after a connection that held so long, 0 when there was none."""
        if held >= PROVEN:
            self._next = FIRST_PAUSE
        pause, self._next = self._next, min(2 * self._next, MAX_PAUSE)
        return pause * random.uniform(1 - JITTER, 1 + JITTER)
