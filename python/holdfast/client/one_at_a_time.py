"""Transports that carry one request at a time, for asyncio: each in a thread of its own."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from holdfast.client.connection import CLOSED
from holdfast.client.endpoint import blocking
from holdfast.errors import ConnectionLost

if TYPE_CHECKING:
    from holdfast._core import Request
    from holdfast.client.target import Target


class OneAtATime:
    """A transport that carries one request at a time, in a thread of its own."""

    def __init__(self, target: Target) -> None:
        self._core = blocking(target)
        self._executor: ThreadPoolExecutor | None = None

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        """Sends a request when its turn has come, and waits for the result."""
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, "holdfast-client")
        loop = asyncio.get_running_loop()
        executor = self._executor
        return await loop.run_in_executor(executor, self._carry, executor, request, unit, timeout)

    def _carry(
        self, executor: ThreadPoolExecutor, request: Request, unit: int, timeout: float
    ) -> Any:
        if executor is not self._executor:
            raise ConnectionLost(CLOSED)
        return self._core.call(request, unit, timeout)

    async def close(self) -> None:
        """Ends the connection, once the call under way has ended; those that wait fail."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.submit(self._core.close)
            await asyncio.to_thread(executor.shutdown)

    @property
    def late(self) -> int:
        """Replies that came too late."""
        return self._core.late
