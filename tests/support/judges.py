"""Devices that judge a fleet: they know which connection every poll came over, and when."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket
import threading
import time
from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.net.server_close import close

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self


@dataclass
class Judge:
    """One device. It takes `delay` seconds to answer, as a slow device does."""

    delay: float = 0.005
    port: int = 0
    polls: list[tuple[float, int]] = field(default_factory=list)
    """The time of each request, and the number of its connection."""
    writes: list[tuple[int, int]] = field(default_factory=list)
    """The number of the connection of each write, and the value."""
    peers: list[int] = field(default_factory=list)
    """The port of the other side of each connection."""
    overlaps: int = 0
    """Requests that came while one of another connection was being answered. If that connection has
    been closed, nobody waits for the answer any more."""
    doubles: list[tuple[float, int, int]] = field(default_factory=list)
    """Connections beside another one: when, the port of the other one, and its own."""
    frozen: set[tuple[int, int]] = field(default_factory=set)
    """Connections of processes that are stopped: the port of the process, and of the device."""
    open: dict[int, socket.socket] = field(default_factory=dict)
    """The connections that have not ended."""
    busy: int | None = None
    talking: set[asyncio.Task[None] | None] = field(default_factory=set)

    async def serve(self) -> asyncio.Server:
        server = await asyncio.start_server(self._talk, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        return server

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.talking.add(asyncio.current_task())
        number = len(self.peers)
        port = writer.get_extra_info("peername")[1]
        others = [self.peers[each] for each, made in self.open.items() if _is_established(made)]
        self.doubles += [
            (time.monotonic(), other, port)
            for other in others
            if (other, self.port) not in self.frozen
        ]
        self.peers.append(port)
        self.open[number] = writer.get_extra_info("socket")
        with contextlib.suppress(OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            while True:
                frame = await reader.readexactly(12)
                if self._is_used_beside(number):
                    self.overlaps += 1
                self.busy = number
                self.polls.append((time.monotonic(), number))
                await asyncio.sleep(self.delay)
                self.busy = None
                if frame[7] == 6:
                    self.writes.append((number, int.from_bytes(frame[10:12])))
                    writer.write(frame)
                else:
                    count = 2 * int.from_bytes(frame[10:12])
                    head = frame[:4] + (3 + count).to_bytes(2) + frame[6:8]
                    writer.write(head + bytes([count]) + bytes(count))
        del self.open[number]
        writer.close()

    def _is_used_beside(self, number: int) -> bool:
        other = None if self.busy is None else self.open.get(self.busy)
        return self.busy != number and other is not None and _is_established(other)

    def returns(self) -> list[tuple[int, int]]:
        """Connections that were used again after another one was, with that other one."""
        found, last, left = [], -1, set[int]()
        for _, number in self.polls:
            if number != last:
                if number in left:
                    found.append((number, last))
                left.add(last)
                last = number
        return found

    def longest_gap(self, since: float) -> float:
        """The longest time without a request, that one included which goes on at `since`."""
        polls = list(self.polls)
        first = max(bisect_left(polls, (since, 0)) - 1, 0)
        ends = [*(at for at, _ in polls[first:]), time.monotonic()]
        return max((after - before for before, after in itertools.pairwise(ends)), default=0.0)

    def is_connected(self) -> bool:
        return any(_is_established(made) for made in list(self.open.values()))


def _is_established(connection: socket.socket) -> bool:
    """Whether neither side has ended a connection, where the system tells."""
    if not hasattr(socket, "TCP_INFO"):
        return False
    try:
        return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] == ESTABLISHED
    except OSError:
        return False


ESTABLISHED = 1
"""The state of a TCP connection, as Linux tells it."""


class Judges:
    """Devices, in a thread of their own."""

    def __init__(self, count: int) -> None:
        self.frozen: set[tuple[int, int]] = set()
        """Connections of processes that are stopped, see `Judge`."""
        self.devices = [Judge(frozen=self.frozen) for _ in range(count)]
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)

    def __enter__(self) -> Self:
        self._thread.start()

        async def start() -> None:
            self._servers = [await device.serve() for device in self.devices]

        asyncio.run_coroutine_threadsafe(start(), self._loop).result()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        async def end() -> None:
            for server in self._servers:
                await close(server)
            # A connection that has just come is closed only by a task that has begun.
            while tasks := asyncio.all_tasks() - {asyncio.current_task()}:
                for task in tasks & self._talking():
                    task.cancel()
                await asyncio.wait(tasks, timeout=0.01)

        asyncio.run_coroutine_threadsafe(end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _talking(self) -> set[asyncio.Task[None] | None]:
        return set().union(*(device.talking for device in self.devices))
