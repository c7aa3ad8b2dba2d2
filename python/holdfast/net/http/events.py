"""Server-sent events: a response that is a stream of events."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from holdfast.net.http.requests import SAFE

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterable

    from holdfast.net.http.requests import Headers, Request

Result = TypeVar("Result")

HEADERS: Headers = [(b"content-type", b"text/event-stream"), (b"x-accel-buffering", b"no"), *SAFE]
"""The headers of a stream. `x-accel-buffering` keeps nginx from holding events back."""


class Stream:
    """Sends events, and comments as heartbeats so that both peers notice a lost connection."""

    def __init__(self, request: Request, heartbeat: float) -> None:
        self._request = request
        self._heartbeat = heartbeat
        self._loop = asyncio.get_running_loop()
        self._last = self._loop.time()
        self.began = False
        """Whether the response has begun."""

    async def begin(self, more_headers: Iterable[tuple[bytes, bytes]] = ()) -> None:
        """Begins the response."""
        self.began = True
        await self._request.begin(200, [*HEADERS, *more_headers])

    async def event(self, name: str, data: Any, number: int | None = None) -> None:
        """Sends one event with JSON data. `number` is its id."""
        head = b"" if number is None else b"id: %d\n" % number
        body = b"event: %b\ndata: %b\n\n" % (name.encode(), _line(data))
        await self._write(head + body)

    async def beat(self) -> None:
        """Sends a heartbeat if nothing was sent for the heartbeat interval."""
        if self._loop.time() - self._last >= self._heartbeat:
            await self._write(b":\n\n")

    async def during(self, work: Coroutine[Any, Any, Result]) -> Result:
        """Returns the result of work, and sends heartbeats meanwhile."""
        task = asyncio.create_task(work)
        try:
            while not (await asyncio.wait([task], timeout=self._heartbeat))[0]:
                await self.beat()
            return task.result()
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def pause(self, until: float) -> None:
        """Waits until a time of the event loop, and sends heartbeats meanwhile."""
        while (left := until - self._loop.time()) > 0:
            await asyncio.sleep(min(left, self._heartbeat))
            await self.beat()

    async def end(self) -> None:
        """Ends the response."""
        await self._request.end()

    async def _write(self, data: bytes) -> None:
        self._last = self._loop.time()
        await self._request.send(data)


def _line(data: Any) -> bytes:
    """Returns JSON without the characters that many clients take for the end of a line."""
    line = msgspec.json.encode(data)
    for character in "\x85\u2028\u2029":
        line = line.replace(character.encode(), b"\\u%04x" % ord(character))
    return line
