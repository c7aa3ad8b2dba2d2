"""Pauses between attempts: each failure doubles the pause, up to a limit.

The core has the same rule for connections to devices (`crates/runtime/src/backoff.rs`).
"""

from __future__ import annotations

import math
import random

JITTER = 0.25
"""With jitter, a pause is up to this fraction shorter at random."""

PROVEN_S = 60.0
"""After an attempt that worked for this long, the next failure counts as the first."""

_MAX_DOUBLINGS = 31
"""Prevents an overflow, as in backoff.rs."""


class Backoff:
    """Counts failures in a row, and returns the pause after each of them.

    `jitter` is for clients of a server that many share: they lose it together, and should not come
    back together. After an attempt that worked for `proven_s` seconds, pauses start from the first
    again; without it, only after `succeeded`.
    """

    def __init__(
        self, first_s: float, max_s: float, *, jitter: bool, proven_s: float = math.inf
    ) -> None:
        self.failures = 0
        """Failures since the last success."""
        self._first_s, self._max_s = first_s, max_s
        self._jitter = jitter
        self._proven_s = proven_s

    def failed(self, worked_s: float = 0.0) -> float:
        """Counts a failure. Returns the seconds to wait before the next attempt.

        `worked_s` is how long the attempt worked before it failed.
        """
        if worked_s >= self._proven_s:
            self.failures = 0
        doublings = min(self.failures, _MAX_DOUBLINGS)
        self.failures += 1
        pause_s = min(self._first_s * 2.0**doublings, self._max_s)
        return pause_s * random.uniform(1 - JITTER, 1) if self._jitter else pause_s

    def succeeded(self) -> None:
        """The next failure is the first again."""
        self.failures = 0
