"""Transports with one request at a time for asyncio, each in its own thread."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any

from holdfast.client.asyncio_connection import CLOSED
from holdfast.client.endpoint import blocking
from holdfast.errors import ConnectionLost

if TYPE_CHECKING:
    from holdfast._core import Request
    from holdfast.client.url import Target


TIMEOUT = 0.2
"""Seconds after which a call is ended again that was not there before."""


class OneAtATime:
    """A transport with one request at a time, in its own thread."""

    def __init__(self, target: Target) -> None:
        self._core = blocking(target)
        self._executor: ThreadPoolExecutor | None = None

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        """Sends a request after the calls before it, and waits for the result."""
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
        """Closes the connection; the current call and waiting calls fail."""
        executor, self._executor = self._executor, None
        if executor is not None:
            await asyncio.to_thread(self._end, executor)

    def _end(self, executor: ThreadPoolExecutor) -> None:
        closed = executor.submit(self._core.close)
        while not closed.done():
            # A call may begin only now.
            self._core.end_call()
            wait([closed], TIMEOUT)
        executor.shutdown()

    @property
    def late(self) -> int:
        """How many replies arrived after their timeout."""
        return self._core.late

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of them took; 0 if there were none."""
        return self._core.longest_late
