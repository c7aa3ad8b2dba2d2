"""Other scanners on the same subjects: each request reaches all of them, and each polls the device.

A scanner announces itself on `PREFIX.scanner`. tentacle-modbus does not; it is noticed because it
writes the same heartbeat. Does no I/O.
"""

from __future__ import annotations

import logging
import time

from holdfast import logs
from holdfast.scanner.messages.types import OtherScanner

FORGET_AFTER_S = 30.0
"""Time after the last sign of another scanner until it is forgotten: three heartbeats."""

MAX_SCANNERS = 100
"""Limit of other scanners that are remembered."""


class OtherScanners:
    """The other scanners, by the time of their start."""

    def __init__(self, started: int) -> None:
        self._started = started
        self._seen: dict[int, float] = {}

    def saw(self, started: int) -> bool:
        """Records a sign of another scanner. Returns whether it is a new one, and then logs it."""
        if started == self._started:
            return False
        now = time.monotonic()
        self._expire(now)
        known = started in self._seen
        if known or len(self._seen) < MAX_SCANNERS:
            self._seen[started] = now
        if not known:
            todo = "stop one of them, or give it another --prefix"
            logs.write(
                logging.WARNING,
                "another_scanner",
                started=logs.timestamp(started / 1000),
                todo=todo,
            )
        return not known

    def current(self) -> list[OtherScanner]:
        """Returns the other scanners that are running."""
        self._expire(time.monotonic())
        return [OtherScanner(started_at=started) for started in sorted(self._seen)]

    def _expire(self, now: float) -> None:
        self._seen = {
            started: seen for started, seen in self._seen.items() if now - seen < FORGET_AFTER_S
        }
