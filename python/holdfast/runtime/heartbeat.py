"""The heartbeat of a Python thread or event loop: others see by it whether it still runs."""

from __future__ import annotations

import time

PERIOD_S = 1.0
"""Seconds between two beats."""


class Heartbeat:
    """A heartbeat. Creating it is the first beat. Reading it is thread-safe."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def beat(self) -> None:
        """Notes that the thread or event loop runs. Call it at least every `PERIOD_S` seconds."""
        self._last = time.monotonic()

    @property
    def age(self) -> float:
        """Seconds since the last beat."""
        return time.monotonic() - self._last
