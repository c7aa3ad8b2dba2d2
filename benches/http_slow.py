"""Measures how REST holds thousands of connections that are idle or slow.

A good client writes ten registers all the time over one connection, which it opens again when it is
closed: alone, and beside the others. What they take of the server's memory and of its core is
measured while the good client is silent.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import subprocess
import sys
import time
from statistics import quantiles
from typing import TYPE_CHECKING, TypeAlias

import common
from common import Result

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

PLACES = """\
  max_connections: 16000
  max_connections_per_source: null
  request_timeout: 3600
"""
KINDS = {
    "15,000 idle connections": ("idle", 15_000, PLACES),
    "10,000 slow senders": ("slow", 10_000, PLACES),
    "10,000 slow senders, default limits": ("slow", 10_000, ""),
}
Variant: TypeAlias = "tuple[str, str, Path | None]"
Request: TypeAlias = "Callable[[str], bytes]"
"""Returns a request to an address."""


class Senders:
    """The slow or idle connections, in a process of their own."""

    def __init__(self, address: str, kind: str, count: int, core: int) -> None:
        self.process = subprocess.Popen(
            common.python("slow_senders.py", address, kind, count),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=common.pinned(core),
        )
        self._read("open")

    def closed(self) -> int:
        """How many of them the server has closed."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return int(self._read(""))

    def _read(self, expected: str) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        if not line.startswith(expected) or not line:
            raise RuntimeError(f"the slow senders have ended: {line}")
        return line


@contextlib.contextmanager
def sending(address: str, kind: str, count: int, core: int) -> Iterator[Senders]:
    """Opens connections, and closes them at the end of the context."""
    senders = Senders(address, kind, count, core)
    try:
        yield senders
    finally:
        senders.process.kill()
        senders.process.communicate()


def measured(
    options: argparse.Namespace, variants: Sequence[Variant], configuration: str, good: Request
) -> dict[str, list[dict[str, Result]]]:
    """Measures each server once per round with each kind, and prints the tables."""
    os.sched_setaffinity(0, {options.other})
    rounds: dict[str, list[dict[str, Result]]] = {title: [] for title in KINDS}
    by_name = {variant[0]: variant for variant in variants}
    for index in range(options.rounds):
        for title, found in rounds.items():
            names = common.turns(list(by_name), index)
            found.append(
                {name: turn(options, by_name[name], configuration, good, title) for name in names}
            )
    for title, found in rounds.items():
        show(title, found, list(by_name))
    return rounds


def turn(
    options: argparse.Namespace, variant: Variant, configuration: str, good: Request, title: str
) -> Result:
    """Measures a server that was just started."""
    (_, loop, checkout), (kind, count, limits) = variant, KINDS[title]
    running = common.appliance(configuration + limits, options.core, 2, loop, checkout)
    with running as server:
        address, pid = server.addresses["rest"], server.process.pid
        client = Client(address, good(address))
        alone, before = client.ask(options.seconds), common.memory(pid)["resident"]
        cpu = server.cpu()
        with sending(address, kind, count, options.other) as senders:
            opened = server.cpu() - cpu
            memory = common.memory(pid)["resident"] - before
            cpu, began, closed = server.cpu(), time.monotonic(), senders.closed()
            time.sleep(options.seconds)
            used = (server.cpu() - cpu) / (time.monotonic() - began)
            beside = client.ask(options.seconds)
            return {
                **{f"alone_{key}": value for key, value in alone.items()},
                **beside,
                "memory": memory / count,
                "open_us": 1e6 * opened / count,
                "core": used,
                "closed": senders.closed() - closed,
            }


class Client:
    """One good client: it keeps its connection as long as the server does."""

    def __init__(self, address: str, request: bytes) -> None:
        host, _, port = address.rpartition(":")
        self._address, self._request = (host, int(port)), request
        self._connection: socket.socket | None = None

    def ask(self, seconds: float) -> Result:
        """Sends requests for some seconds. Returns latencies in microseconds, and failures."""
        times, failed = [], 0
        now, end = time.perf_counter(), time.perf_counter() + seconds
        while now < end:
            began = now
            try:
                self._ask()
            except OSError:
                failed += 1
                self._connection = None
            now = time.perf_counter()
            if self._connection is not None:
                times.append(1e6 * (now - began))
        cuts = quantiles(times, n=100) if len(times) > 1 else [math.nan] * 99
        rate = len(times) / seconds
        return {"p50": cuts[49], "p99": cuts[98], "rate": rate, "failed": failed / seconds}

    def _ask(self) -> None:
        if self._connection is None:
            self._connection = socket.create_connection(self._address, common.TIMEOUT)
        self._connection.sendall(self._request)
        answer = self._connection.recv(4096)
        while answer and not answer.endswith(b"}"):
            answer += self._connection.recv(4096)
        if not answer.startswith(b"HTTP/1.1 200 "):
            raise ConnectionError(answer)


def show(title: str, rounds: list[dict[str, Result]], names: Sequence[str]) -> None:
    """Prints one table."""
    print(f"\n{title}; a good client beside them, and alone:")
    print(
        "  server                 p50 us (alone)    p99 us (alone)  requests/s (alone)  failed/s"
        "   bytes each  us to open each  % of a core  closed"
    )
    keys = "p50", "alone_p50", "p99", "alone_p99", "rate", "alone_rate"
    for name in names:
        figures = common.medians(rounds, name, *keys)
        times = [f"{figures[at]:,.0f} ({figures[at + 1]:,.0f})" for at in (0, 2, 4)]
        failed, memory, opened, core, closed = common.medians(
            rounds, name, "failed", "memory", "open_us", "core", "closed"
        )
        print(
            f"  {name:20}  {times[0]:>15}  {times[1]:>16}  {times[2]:>18}  {failed:8,.0f}"
            f"  {memory:11,.0f}  {opened:15.0f}  {100 * core:11.1f}  {closed:6,.0f}"
        )
    sys.stdout.flush()
