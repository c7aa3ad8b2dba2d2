"""Which commands are too late: they may have been on their way longer than a person expects.

A message has no time of its own, but the broker has sent what arrives after it answered the last
ping that is answered. Without an answer for long, the network stood still, or this side has much to
send.
"""

from __future__ import annotations

import time

PING_INTERVAL_S = 2.0
"""Seconds between two pings while commands are taken."""

MAX_COMMAND_AGE_S = 5.0
"""Seconds that a command may have been on its way from the broker."""


class Pings:
    """The pings of one connection."""

    def __init__(self) -> None:
        self.is_waiting = False
        """Whether the last ping has no answer yet."""
        self._sent_at = self._answered_at = time.monotonic()
        """When the last ping was sent, and when the last one that is answered was."""

    def sent(self) -> None:
        """Notes that a ping is sent now."""
        self._sent_at, self.is_waiting = time.monotonic(), True

    def answered(self) -> None:
        """Notes the answer to the last ping."""
        self._answered_at, self.is_waiting = self._sent_at, False

    def age(self) -> float:
        """Seconds since the last ping was sent."""
        return time.monotonic() - self._sent_at

    def lateness(self) -> str | None:
        """Why a command that arrives now may be too late."""
        age = time.monotonic() - self._answered_at
        late = f"it may be {age:.0f} s late: no ping was answered since"
        return late if age > MAX_COMMAND_AGE_S else None
