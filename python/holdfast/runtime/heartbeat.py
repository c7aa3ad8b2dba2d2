"""The heartbeat of a Python thread or event loop: others see by it whether it still runs."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

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

    @contextlib.asynccontextmanager
    async def beating(self) -> AsyncIterator[None]:
        """Beats in this event loop until the block ends."""
        task = asyncio.create_task(self._keep())
        try:
            yield
        finally:
            task.cancel()

    async def _keep(self) -> None:
        while True:
            self.beat()
            await asyncio.sleep(PERIOD_S)
