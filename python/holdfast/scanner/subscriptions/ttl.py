"""Ends subscriptions with a `ttl` that are not repeated in time. Does no I/O.

The time runs only while NATS is connected: a subscriber can't repeat a request that can't arrive.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING

from holdfast.scanner.jetstream.store import Unit

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable


class Expiring:
    """The subscriptions with a `ttl`, and when each ends."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ttls: dict[Unit, int] = {}
        self._ends: dict[Unit, float] = {}
        self._runs = False
        self._news = asyncio.Event()

    def renew(self, device: str, subscriber: str, ttl: int | None) -> None:
        """Starts the time of a subscription again; without `ttl`, it does not end."""
        unit = Unit(device, subscriber)
        if ttl is None:
            self._ttls.pop(unit, None)
            self._ends.pop(unit, None)
            return
        self._ttls[unit] = ttl
        self._ends[unit] = self._clock() + ttl
        self._news.set()

    def connected(self, is_connected: bool) -> None:
        """Stops the time of all subscriptions, or starts it again."""
        self._runs = is_connected
        if is_connected:
            now = self._clock()
            self._ends = {unit: now + ttl for unit, ttl in self._ttls.items()}
        self._news.set()

    def is_due(self, unit: Unit) -> bool:
        """Returns whether a subscription ends now."""
        return self._runs and unit in self._ends and self._ends[unit] <= self._clock()

    async def run(self, end: Callable[[Unit], Awaitable[None]]) -> None:
        """Calls `end` for each subscription that is due, until it is cancelled.

        After `end`, it must not be due any more.
        """
        while True:
            for unit in list(filter(self.is_due, self._ends)):
                await end(unit)
            self._news.clear()
            left = None
            if self._runs and self._ends:
                left = max(min(self._ends.values()) - self._clock(), 0.0)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left):
                    await self._news.wait()
