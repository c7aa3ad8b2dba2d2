"""How a node hands partitions over: a few at once while it goes on, all at once when it leaves."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from holdfast.replication.leases.thread import LeaseThread

MAX_CONCURRENT_HANDOVERS = 4
"""Partitions that a node gives back at once, while it goes on."""

DEVICE_STOP_TIMEOUT_S = 5.0
"""Time to wait for polls and writes of a partition before it is given back."""


class Handover:
    """The handovers of one node. `given_back` is called with the lease after each."""

    def __init__(self, thread: LeaseThread, given_back: Callable[[str], None]) -> None:
        self._thread = thread
        self._given_back = given_back
        self._running: dict[str, asyncio.Task[None]] = {}
        self._turns = asyncio.Semaphore(MAX_CONCURRENT_HANDOVERS)

    def begin(self, keys: Iterable[str]) -> None:
        """Begins to give these leases back, but those that are being given back already."""
        for key in keys:
            if key not in self._running:
                self._running[key] = asyncio.create_task(self._in_turn(key))

    async def at_once(self, keys: Iterable[str]) -> None:
        """Gives all these leases back, and waits for it."""
        await asyncio.gather(*(self._give_back(key) for key in keys))

    async def _in_turn(self, key: str) -> None:
        try:
            async with self._turns:
                await self._give_back(key)
        finally:
            del self._running[key]

    async def _give_back(self, key: str) -> None:
        await self._thread.give_back(key, DEVICE_STOP_TIMEOUT_S)
        self._given_back(key)
