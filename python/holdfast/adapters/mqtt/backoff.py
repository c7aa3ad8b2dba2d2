"""The pauses between attempts to connect to the broker."""

from __future__ import annotations

import random

FIRST_PAUSE = 1.0
MAX_PAUSE = 10.0
"""Seconds, by default. Each failure doubles the pause. After an outage, the longest pause is added
to it."""

JITTER = 0.25
"""A pause varies randomly by this fraction, so that clients do not all reconnect at once."""

PROVEN = 10.0
"""After a connection of at least this many seconds, the pauses start from the first again."""


class Backoff:
    """An exponential backoff with jitter."""

    def __init__(self, first_pause: float = FIRST_PAUSE, max_pause: float = MAX_PAUSE) -> None:
        self._first_pause, self._max_pause = first_pause, max_pause
        self._next = first_pause

    def pause(self, held: float) -> float:
        """Returns the seconds to wait after a connection of `held` seconds, 0 for none."""
        if held >= PROVEN:
            self._next = self._first_pause
        pause, self._next = self._next, min(2 * self._next, self._max_pause)
        return pause * random.uniform(1 - JITTER, 1 + JITTER)
