"""Faults of a simulated device: a front that delays, drops and refuses requests."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from holdfast.net.addresses import holds, parse_address
from holdfast.net.server_close import close
from holdfast.runtime.tasks import end

if TYPE_CHECKING:
    from collections.abc import Sequence
    from random import Random

    from holdfast.net.addresses import Network

HEADER_BYTES = 7
MAX_LENGTH_FIELD = 254
MAX_CONNECTIONS = 64
IDLE_TIMEOUT_S = 300.0
REPLY_TIMEOUT_S = 5.0
"""Seconds for which the device behind the front may take."""


@dataclass(frozen=True)
class Faults:
    """What happens to requests, and how often, from 0 to 1."""

    latency: tuple[float, float] = (0, 0)
    """The least and the largest delay of a reply, in seconds."""
    drop: float = 0
    """The share of requests without a reply."""
    refuse: float = 0
    """The share of requests that an exception answers."""
    code: int = 4
    """The code of this exception."""

    @property
    def any(self) -> bool:
        """Whether anything happens at all."""
        return self.latency[1] > 0 or self.drop > 0 or self.refuse > 0


@dataclass(eq=False)
class FaultProxy:
    """Serves Modbus TCP at `address`, and asks the device at `behind`, from `start` to `stop`.

    Peers that are in none of the networks `sources` are disconnected. The requests of a connection
    are answered one after another.
    """

    address: tuple[str, int]
    behind: tuple[str, int]
    faults: Faults
    random: Random
    sources: Sequence[Network]

    def __post_init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.StreamWriter, asyncio.Task[None]] = {}
        self._thread = threading.Thread(target=self._loop.run_forever, name="faults", daemon=True)

    def start(self) -> Self:
        """Listens. Raises `OSError`."""
        self._thread.start()
        try:
            self._server = asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result()
        except BaseException:
            self._end()
            raise
        self.address = self._server.sockets[0].getsockname()[:2]
        return self

    def stop(self) -> None:
        """Closes all connections and stops listening."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._end()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    async def _listen(self) -> asyncio.Server:
        if self.address[0] != "::":
            return await asyncio.start_server(self._accept, *self.address)
        # asyncio would accept only IPv6 there, unlike all other servers.
        both = socket.has_dualstack_ipv6()
        opened = socket.create_server(self.address, family=socket.AF_INET6, dualstack_ipv6=both)
        return await asyncio.start_server(self._accept, sock=opened)

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _close(self) -> None:
        if self._server is not None:
            await close(self._server)
        for writer in self._connections:
            writer.transport.abort()
        await end(self._connections.values())

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Begins to serve a connection, which `_close` can end from now on."""
        serving = self._loop.create_task(self._serve(reader, writer))
        self._connections[writer] = serving
        serving.add_done_callback(lambda _: self._connections.pop(writer))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            peer = parse_address(writer.get_extra_info("peername")[0].partition("%")[0])
            if holds(self.sources, peer) and len(self._connections) <= MAX_CONNECTIONS:
                with contextlib.suppress(OSError, EOFError, TimeoutError):
                    await self._pass_on(reader, writer)
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        behind, to_behind = await asyncio.open_connection(*self.behind)
        try:
            while True:
                request = await asyncio.wait_for(_frame(reader), IDLE_TIMEOUT_S)
                reply = await self._reply(request, behind, to_behind)
                if reply is not None:
                    writer.write(reply)
                    await asyncio.wait_for(writer.drain(), IDLE_TIMEOUT_S)
        finally:
            to_behind.transport.abort()

    async def _reply(
        self, request: bytes, behind: asyncio.StreamReader, to_behind: asyncio.StreamWriter
    ) -> bytes | None:
        """The reply to a request; `None` if it is dropped."""
        faults, chance = self.faults, self.random.random()
        least, most = faults.latency
        await asyncio.sleep(self.random.uniform(least, most))
        if chance < faults.drop:
            return None
        if chance < faults.drop + faults.refuse:
            length = struct.pack(">H", 3)
            code = bytes([request[HEADER_BYTES] | 0x80, faults.code])
            return request[:4] + length + request[6:7] + code
        to_behind.write(request)
        return await asyncio.wait_for(_frame(behind), REPLY_TIMEOUT_S)


async def _frame(reader: asyncio.StreamReader) -> bytes:
    """The next frame. Raises `EOFError` at the end, and for bytes that are no frame."""
    head = await reader.readexactly(HEADER_BYTES)
    protocol, length = struct.unpack(">HH", head[2:6])
    if protocol != 0 or not 2 <= length <= MAX_LENGTH_FIELD:
        raise EOFError
    return head + await reader.readexactly(length - 1)
