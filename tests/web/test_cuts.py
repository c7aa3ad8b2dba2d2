"""HTTP requests cut and joined in every way: the responses and what they do are the same.

The protocol runs without a socket: between two pieces, either nothing else runs, or everything that
can.
"""

from __future__ import annotations

import asyncio
import itertools
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

import pytest

import holdfast
from holdfast.adapters.rest.app import App
from holdfast.adapters.rest.operations import OPERATIONS
from holdfast.web.host import ConnectionLimits, Host
from support import web, wire

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence


class Outcome(NamedTuple):
    """What a client sees, what was written, and how many requests were broken."""

    received: bytes
    is_closed: bool
    coils: list[int]
    broken: int


class Transport(asyncio.Transport):
    """A connection whose bytes are handed over by a test."""

    def __init__(self) -> None:
        super().__init__({"peername": ("127.0.0.1", 50000), "sockname": ("127.0.0.1", 80)})
        self.written = b""
        self.is_paused = self._closing = False

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Nothing is ever buffered."""

    def is_closing(self) -> bool:
        return self._closing

    def pause_reading(self) -> None:
        self.is_paused = True

    def resume_reading(self) -> None:
        self.is_paused = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        if not self._closing:
            self.written += bytes(data)

    def close(self) -> None:
        self._closing = True

    def abort(self) -> None:
        self._closing = True


class Rest:
    """A REST service without sockets of its own."""

    def __init__(self, service: web.Service, memory: holdfast.Memory) -> None:
        self.memory = memory
        self.host = Host(
            "rest",
            App(
                OPERATIONS,
                service.settings,
                service.memory_access,
                service.diagnostics,
                web.NoSessions(),
            ),
            service.listener,
            sources=service.settings.sources,
            limits=ConnectionLimits(9),
            request_timeout=wire.DEADLINE,
        )
        self.connections, self.connected = self.host.protocols(asyncio.get_running_loop())

    async def outcome(self, pieces: Sequence[bytes], *, pausing: bool = False) -> Outcome:
        """Hands the pieces over; with `pausing`, all that can run does so between them."""
        self.memory.write("coils", 0, [0] * 8)
        broken = self.host.counts()["broken_request"]
        connection, transport = self.connected(), Transport()
        connection.connection_made(transport)
        for piece in pieces:
            if transport.is_paused or pausing:
                await settled()
            assert transport.is_closing() or not transport.is_paused
            if not transport.is_closing():
                connection.data_received(piece)
        await settled()
        if not transport.is_closing() and not connection.eof_received():
            transport.close()
        await settled()
        is_closed = transport.is_closing()
        connection.connection_lost(None)
        await settled()
        assert not self.connections.tasks
        broken = self.host.counts()["broken_request"] - broken
        return Outcome(transport.written, is_closed, self.memory.read("coils", 0, 8), broken)


async def settled() -> None:
    """Lets everything run that waits for nothing."""
    for _ in range(20):
        await asyncio.sleep(0)


def write(address: int, *headers: str) -> bytes:
    body = b'{"memory":"plant_a","area":"coils","address":%d,"values":[1]}' % address
    return web.post(body, *headers)


def chunked(address: int, *headers: str, size: int = 9) -> bytes:
    kind = ("Content-Type: application/json", "Transfer-Encoding: chunked", *headers)
    _, _, body = write(address).partition(b"\r\n\r\n")
    chunks = [body[at : at + size] for at in range(0, len(body), size)]
    framed = b"".join(b"%x\r\n%b\r\n" % (len(chunk), chunk) for chunk in chunks)
    return web.head("POST", web.INGEST, *kind) + framed + b"0\r\n\r\n"


HEALTH = web.head("GET", "/api/v1/health")
OFFER = ("Connection: Upgrade", "Upgrade: websocket")
JSON = "Content-Type: application/json"
CASES: dict[str, bytes] = {
    "read": HEALTH,
    "write": write(0),
    "chunked": chunked(1),
    "offer": write(2, *OFFER),
    "absent": web.head("GET", "/nowhere"),
    "not JSON": web.post(b"{", "X-Y: z"),
    "other type": write(3).replace(b"application/json", b"text/plain"),
    "asks first": write(4, "Expect: 100-continue"),
    "last": write(5, "Connection: close"),
    "old": write(6).replace(b"HTTP/1.1", b"HTTP/1.0"),
    "no HTTP": b"\x00garbage\r\n\r\n",
    "no host": b"GET http:// HTTP/1.1\r\n\r\n",
    "other version": HEALTH.replace(b"HTTP/1.1", b"HTTP/2.0"),
    "wrong header": web.head("GET", "/api/v1/health", "X : y"),
    "wrong chunk": chunked(7).replace(b"\r\n0\r\n", b"\r\nx\r\n"),
    "wrong chunk of another type": web.head("POST", web.INGEST, "Transfer-Encoding: chunked")
    + b"x\r\n",
    "lengths": web.head("POST", web.INGEST, JSON, "Content-Length: 1", "Content-Length: 2") + b"xx",
    "too long": web.head("POST", web.INGEST, JSON, "Content-Length: 1025") + b" " * 1025,
}


def cuts(sent: bytes) -> Iterator[list[bytes]]:
    """The bytes cut in two at every byte, and byte by byte; not within what is long."""
    most = min(len(sent), 400)
    for cut in range(1, most):
        yield [sent[:cut], sent[cut:]]
    yield [*(sent[at : at + 1] for at in range(most)), sent[most:]]


def check(compare: Callable[[Rest], Awaitable[None]]) -> None:
    async def run() -> None:
        memory = holdfast.Memory(coils=8)
        service = web.Service({"plant_a": memory}, max_body=1024)
        with closing(service.listener):
            await compare(Rest(service, memory))

    asyncio.run(run())


@pytest.mark.parametrize("name", CASES)
def test_a_request_has_the_same_outcome_however_it_is_cut(name: str) -> None:
    async def compare(rest: Rest) -> None:
        whole = await rest.outcome([CASES[name]])
        for pieces, pausing in itertools.product(cuts(CASES[name]), (False, True)):
            assert await rest.outcome(pieces, pausing=pausing) == whole, (pieces, pausing)

    check(compare)


@pytest.mark.parametrize("name", CASES)
def test_joined_requests_have_the_same_outcome_as_those_that_are_sent_apart(name: str) -> None:
    async def compare(rest: Rest) -> None:
        for other in CASES:
            sent = [CASES[name], CASES[other], HEALTH]
            apart = await rest.outcome(sent, pausing=True)
            assert await rest.outcome([b"".join(sent)]) == apart, other
            assert await rest.outcome(sent) == apart, other

    check(compare)
