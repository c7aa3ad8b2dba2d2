"""Ends subscriptions with a `ttl` that are not repeated in time. Does no I/O.

The time runs only while NATS is connected: a subscriber can't repeat a request that can't arrive.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from holdfast.runtime import tasks

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast.scanner.subscriptions.key import SubscriptionKey


class SubscriptionTtls:
    """The subscriptions with a `ttl`, and when each ends."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ttls: dict[SubscriptionKey, int] = {}
        self._ends: dict[SubscriptionKey, float] = {}
        self._is_running = False
        self._changed = asyncio.Event()

    def renew(self, key: SubscriptionKey, ttl: int | None) -> None:
        """Starts the time of a subscription again; without `ttl`, it does not end."""
        if ttl is None:
            self._ttls.pop(key, None)
            self._ends.pop(key, None)
            return
        self._ttls[key] = ttl
        self._ends[key] = self._clock() + ttl
        self._changed.set()

    def ends(self, key: SubscriptionKey) -> bool:
        """Returns whether the time of a subscription runs."""
        return key in self._ends

    def connected(self, is_connected: bool) -> None:
        """Stops the time of all subscriptions, or starts it again."""
        self._is_running = is_connected
        if is_connected:
            now = self._clock()
            self._ends = {key: now + ttl for key, ttl in self._ttls.items()}
        self._changed.set()

    def is_due(self, key: SubscriptionKey) -> bool:
        """Returns whether a subscription ends now."""
        return self._is_running and key in self._ends and self._ends[key] <= self._clock()

    async def run(self, end: Callable[[SubscriptionKey], Awaitable[None]]) -> None:
        """Calls `end` for each subscription that is due, until it is cancelled.

        After `end`, it must not be due any more.
        """
        while True:
            # A list: `end` changes the dictionary.
            for key in list(filter(self.is_due, self._ends)):
                await end(key)
            self._changed.clear()
            left = None
            if self._is_running and self._ends:
                left = max(min(self._ends.values()) - self._clock(), 0.0)
            await tasks.within(left, self._changed.wait())
