"""When the values of a group are due: at the first scan after its rate has passed."""

from __future__ import annotations

import math

SLACK_S = 0.0005
"""Tolerance for comparing scheduled times, which the poller rounds."""


class DueTime:
    """When a group is due. A tag on a device that others scan more often waits for a scan."""

    def __init__(self, rate_s: float, before: DueTime | None) -> None:
        """With `before`, the time of the last publication stays as it was."""
        self._rate_s = rate_s
        self._last: float = -math.inf if before is None else before._last

    @property
    def is_due_at_once(self) -> bool:
        """Whether the next scan is published, whenever it comes."""
        return self._last == -math.inf

    def make_due(self) -> None:
        """Makes the next scan due."""
        self._last = -math.inf

    def claim(self, scan: float) -> bool:
        """Returns whether a scan at this time, in seconds, is due. Then it counts as published."""
        if scan < self._last + self._rate_s - SLACK_S:
            return False
        self._last = scan
        return True
