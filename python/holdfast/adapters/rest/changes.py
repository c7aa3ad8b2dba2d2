"""The change stream: what changes in ranges of a memory, as server-sent events.

A stream looks at the memory at most once per `min_interval`, and only when its peer has taken the
events before. So a slow peer receives the newest values, and nothing is queued for it. While the
memory can't be read because its log is behind, or a range because what it mirrors is stale, a
stream says so and waits. Which part of a range an event has: crates/memory/src/follower.rs.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from holdfast.ingest import unreadable
from holdfast.net.http.events import Stream
from holdfast.net.http.requests import BadRequest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.ingest import Follower
    from holdfast.net.http.requests import Request

MAX_STREAMS = 32
"""The most open streams. At most half of the connections of the server are streams."""

MAX_RANGES = 16
"""The most ranges of one stream."""

MAX_VALUES = 65_536
"""The most values in all ranges of one stream."""

MIN_INTERVAL_S = 0.05
MAX_INTERVAL_S = 3600
DEFAULT_INTERVAL_S = 0.1
"""The limits of `min_interval`, and what it is if a request has none."""

HEARTBEAT_INTERVAL_S = 15.0
"""The longest time in seconds between two events or comments of a stream."""

EVENT = "values"
UNAVAILABLE = "unavailable"


class ChangeStreams:
    """The open change streams of one server."""

    def __init__(self, max_connections: int) -> None:
        self.most = min(MAX_STREAMS, max(1, max_connections // 2))
        self.open = 0
        self._ending = asyncio.Event()

    def end(self) -> None:
        """Ends all streams. Called in the thread of the server."""
        self._ending.set()

    @contextlib.contextmanager
    def place(self) -> Iterator[None]:
        """Counts a stream. Raises `BadRequest` above the limit."""
        if self.open >= self.most:
            detail = f"too many change streams: {self.most} are open, which is the limit"
            raise BadRequest("busy", detail)
        self.open += 1
        try:
            yield
        finally:
            self.open -= 1

    async def serve(
        self,
        request: Request,
        follower: Follower,
        ranges: Sequence[tuple[str, str]],
        min_interval: float,
    ) -> None:
        """Sends events until the peer leaves or the server stops. Called in a `place`.

        `ranges` are the memory and the area of each range of the follower.
        """
        gone = asyncio.Event()
        request.when_gone(gone.set)
        ends = [asyncio.create_task(event.wait()) for event in (gone, self._ending)]
        try:
            stream = Stream(request, HEARTBEAT_INTERVAL_S)
            await stream.begin()
            await _follow(stream, follower, ranges, min_interval, ends)
            await stream.end()
        finally:
            for each in ends:
                each.cancel()
            await asyncio.gather(*ends, return_exceptions=True)


async def _follow(
    stream: Stream,
    follower: Follower,
    ranges: Sequence[tuple[str, str]],
    min_interval: float,
    ends: Sequence[asyncio.Task[object]],
) -> None:
    """Sends events until one of the tasks `ends` is done."""
    loop = asyncio.get_running_loop()
    due = loop.time()
    refusal = reason = ""
    while not any(task.done() for task in ends):
        if loop.time() >= due:
            due = loop.time() + min_interval
            before = refusal
            try:
                (sequence, changes), refusal = follower.changes(), ""
            except OSError as error:
                changes, refusal, reason = [], str(error), unreadable(error)
            if refusal and refusal != before:
                memory, _ = ranges[0]
                notice = {"memory": memory, "reason": reason, "detail": refusal}
                await stream.event(UNAVAILABLE, notice)
            for index, address, values in changes:
                memory, area = ranges[index]
                data = {"memory": memory, "area": area, "address": address, "values": values}
                await stream.event(EVENT, data, sequence)
        await stream.beat()
        pause = max(0.0, min(due - loop.time(), HEARTBEAT_INTERVAL_S))
        await asyncio.wait(ends, timeout=pause, return_when=asyncio.FIRST_COMPLETED)
