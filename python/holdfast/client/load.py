"""Load tests of a Modbus server: sends as many reads as it answers, and measures each.

The asyncio clients run in one thread, which limits the test to some tens of thousands of reads per
second.
"""

from __future__ import annotations

import asyncio
import bisect
import contextlib
import math
import time
from collections import Counter
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

from holdfast.client import Client
from holdfast.client.base import DEFAULT_TIMEOUT_S
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import IN_FLIGHT, NetworkTarget, parse
from holdfast.errors import (
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    RequestTimeout,
)
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, READ_LIMITS

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.types import Area

MIN_LATENCY_S = 1e-6
GROWTH = math.log(1.02)
"""Times are recorded with a precision of 2 percent."""

EDGES_S = [digit * 10.0**exponent for exponent in range(-6, 4) for digit in (1, 2, 5)]
"""The edges of the histogram's bars, in seconds."""

MAX_CONNECTIONS = 1000
RECONNECT_PAUSE_S = 0.1
"""Seconds before a reconnect."""

PROGRESS_INTERVAL_S = 0.1
"""Seconds between two calls of `progress`."""


class Latencies:
    """Latencies of any number of requests, in constant memory."""

    def __init__(self) -> None:
        self.count = 0
        self.total = 0.0
        self.least = math.inf
        self.most = 0.0
        self._counts: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Adds a latency, in seconds."""
        self.count += 1
        self.total += seconds
        self.least = min(self.least, seconds)
        self.most = max(self.most, seconds)
        self._counts[
            max(0, int(math.log(max(seconds, MIN_LATENCY_S) / MIN_LATENCY_S) / GROWTH))
        ] += 1

    @property
    def mean(self) -> float:
        """The average in seconds; 0 without requests."""
        return self.total / self.count if self.count else 0.0

    def quantile(self, share: float) -> float:
        """The quantile of a share, in seconds, within 2 percent; 0 without requests."""
        position = max(1, math.ceil(share * self.count))
        seen = 0
        for step in sorted(self._counts):
            seen += self._counts[step]
            if seen >= position:
                return min(self.most, max(self.least, _middle(step)))
        return 0.0

    def histogram(self) -> list[tuple[float, float, int]]:
        """Start, end and count of each bar, from the first to the last non-empty bar."""
        bars = [0] * (len(EDGES_S) + 1)
        for step, count in self._counts.items():
            bars[bisect.bisect_right(EDGES_S, min(self.most, _middle(step)))] += count
        filled = [at for at, count in enumerate(bars) if count]
        if not filled:
            return []
        edges = [0.0, *EDGES_S, math.inf]
        return [(edges[at], edges[at + 1], bars[at]) for at in range(filled[0], filled[-1] + 1)]


@dataclass(eq=False)
class Load:
    """Reads one range over several connections, with requests in flight, for some seconds."""

    url: str
    area: Area
    address: int
    count: int
    _: KW_ONLY
    unit: int = 1
    connections: int = 1
    in_flight: int = 1
    seconds: float = 5.0
    timeout: float = DEFAULT_TIMEOUT_S

    def __post_init__(self) -> None:
        target, limit = parse(self.url), READ_LIMITS[self.area]
        if not 1 <= self.count <= limit:
            raise ValueError(f"count is {self.count}, allowed: 1 to {limit}")
        if not 0 <= self.address <= ADDRESSES - self.count:
            found = f"{self.count} from address {self.address}"
            raise ValueError(f"{found}: the last address is {LAST_ADDRESS}")
        if not 1 <= self.connections <= MAX_CONNECTIONS:
            raise ValueError(f"connections is {self.connections}, allowed: 1 to {MAX_CONNECTIONS}")
        if isinstance(target, SerialTarget) and self.connections > 1:
            raise ValueError("a serial line has one connection")
        many = isinstance(target, NetworkTarget) and target.transport in IN_FLIGHT
        if self.in_flight > 1 and not many:
            raise ValueError("more than one request in flight requires tcp or tls")
        self.elapsed = 0.0
        """Seconds since the start of the test."""
        self.latencies = Latencies()
        self.errors: Counter[str] = Counter()
        self.error: ModbusError | None = None
        """The newest error."""
        self._clients = [
            Client(self.url, unit=self.unit, timeout=self.timeout, max_in_flight=self.in_flight)
            for _ in range(self.connections)
        ]

    @property
    def rate(self) -> float:
        """Reads per second."""
        return self.latencies.count / self.elapsed if self.elapsed else 0.0

    async def run(self, progress: Callable[[Load], object] | None = None) -> None:
        """Runs the test; calls `progress` periodically.

        Before the test, connects every client and reads once. Raises the error of the first client.
        """
        try:
            await self._read(self._clients[0])
            await asyncio.gather(*(self._warmed_up(client) for client in self._clients[1:]))
            await self._loaded(progress)
        finally:
            for client in self._clients:
                await client.close()

    async def _loaded(self, progress: Callable[[Load], object] | None) -> None:
        began = time.perf_counter()
        workers = [
            asyncio.create_task(self._work(client, began + self.seconds))
            for client in self._clients
            for _ in range(self.in_flight)
        ]
        try:
            left = set(workers)
            while left:
                _, left = await asyncio.wait(left, timeout=PROGRESS_INTERVAL_S)
                self.elapsed = time.perf_counter() - began
                if progress is not None:
                    progress(self)
        finally:
            self.elapsed = time.perf_counter() - began
            for worker in workers:
                worker.cancel()
            await asyncio.gather(*workers, return_exceptions=True)
        for worker in workers:
            worker.result()

    async def _warmed_up(self, client: Client) -> None:
        with contextlib.suppress(ModbusError):
            await self._read(client)

    async def _work(self, client: Client, end: float) -> None:
        """Reads repeatedly until the end of the test."""
        while (began := time.perf_counter()) < end:
            try:
                await self._read(client)
            except ModbusError as error:
                self.errors[_kind(error)] += 1
                self.error = error
                if isinstance(error, ConnectionLost):
                    await asyncio.sleep(min(RECONNECT_PAUSE_S, max(0.0, end - time.perf_counter())))
            else:
                self.latencies.add(time.perf_counter() - began)

    async def _read(self, client: Client) -> None:
        await getattr(client, f"read_{self.area}")(self.address, self.count)


def _kind(error: ModbusError) -> str:
    """The category of an error."""
    if isinstance(error, RequestTimeout):
        return "timeout"
    if isinstance(error, ConnectionLost):
        return "connection lost"
    return "invalid response" if isinstance(error, InvalidResponse) else str(error)


def _middle(step: int) -> float:
    """The latency that represents a step."""
    return MIN_LATENCY_S * math.exp(GROWTH * (step + 0.5))
