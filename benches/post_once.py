"""A closed-loop load that sends one HTTP request per connection, and checks every reply.

It prints the same JSON as the loads in Rust.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import socket
import time
from pathlib import Path
from statistics import quantiles

WARMUP = 0.3
TIMEOUT = 10


class Load:
    """The clients and their results."""

    def __init__(self, options: argparse.Namespace) -> None:
        host, _, port = options.address.rpartition(":")
        self.address = (host, int(port))
        body = options.body.read_bytes()
        self.request = (
            f"POST {options.path} HTTP/1.1\r\nHost: {options.address}\r\nConnection: close\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        ).encode() + body
        self.seconds = options.seconds
        self.latencies: list[float] = []
        self.answered = 0

    async def run(self, clients: int) -> None:
        """Runs all clients."""
        expected = await self.ask()
        self.begin = time.perf_counter() + WARMUP
        self.end = self.begin + self.seconds
        async with asyncio.timeout(WARMUP + self.seconds + TIMEOUT):
            await asyncio.gather(*(self._client(expected) for _ in range(clients)))

    async def _client(self, expected: bytes) -> None:
        now = time.perf_counter()
        while now < self.end:
            sent = now
            if await self.ask() != expected:
                raise RuntimeError("a reply differs from the first reply")
            now = time.perf_counter()
            self.answered += 1
            if self.begin <= now < self.end:
                self.latencies.append(now - sent)

    async def ask(self) -> bytes:
        """Sends the request on a new connection. Returns the body of the reply."""
        loop = asyncio.get_running_loop()
        with socket.socket() as connection:
            connection.setblocking(False)
            await loop.sock_connect(connection, self.address)
            await loop.sock_sendall(connection, self.request)
            reply = b""
            while received := await loop.sock_recv(connection, 4096):
                reply += received
        head, _, body = reply.partition(b"\r\n\r\n")
        if not head.startswith(b"HTTP/1.1 200 "):
            raise RuntimeError(f"expected status 200, found {reply[:500]!r}")
        return body


def main() -> None:
    """Prints the rate, and the latencies in microseconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--address", required=True)
    parser.add_argument("--path", required=True)
    parser.add_argument("--body", type=Path, required=True)
    parser.add_argument("--connections", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=2)
    options = parser.parse_args()
    load = Load(options)
    began, cpu = time.perf_counter(), time.process_time()
    asyncio.run(load.run(options.connections))
    busy = (time.process_time() - cpu) / (time.perf_counter() - began)
    requests = len(load.latencies)
    cuts = quantiles(load.latencies, n=100) if requests > 1 else [0.0] * 99
    outcome = {
        "requests": requests,
        "answered": load.answered,
        "rate": requests / options.seconds,
        "p50": cuts[49] * 1e6,
        "p99": cuts[98] * 1e6,
        "busy": busy,
    }
    print(json.dumps(outcome))


if __name__ == "__main__":
    main()
