"""Who has to leave an HTTP server that is full. The core tests the rules: `eviction.rs`."""

from __future__ import annotations

import asyncio
import socket
from contextlib import ExitStack, closing
from ipaddress import ip_network
from typing import TYPE_CHECKING, Any

from holdfast.net.http.port import listen
from holdfast.net.http.requests import Request, Response
from holdfast.net.http.server import ConnectionLimits, WebServer
from support import web, wire

if TYPE_CHECKING:
    from collections.abc import Coroutine


def test_event_streams_are_never_evicted() -> None:
    async def streamed(request: Request) -> None:
        await request.begin(200, [])
        while True:
            await request.send(b"x")
            await asyncio.sleep(0.01)

    def answer(request: Request) -> Response | Coroutine[Any, Any, None]:
        return streamed(request) if request.path == "/stream" else Response(200)

    listener = listen("127.0.0.1", 0)
    limits = ConnectionLimits(2, when_full="evict")
    sources = [ip_network("127.0.0.0/8")]
    server = WebServer("x", answer, listener, sources=sources, limits=limits, request_timeout=9)
    address: tuple[str, int] = listener.getsockname()
    with closing(listener), web.in_a_thread(server), ExitStack() as opened:
        streams = [opened.enter_context(wire.Connection(address)) for _ in range(2)]
        for stream in streams:
            stream.send(web.head("GET", "/stream"))
            assert stream.socket.recv(1)
        with socket.create_connection(address, timeout=wire.DEADLINE) as another:
            assert another.recv(1) == b""
        assert (server.counts()["refused_full"], server.counts()["evicted"]) == (1, 0)
        for stream in streams:
            assert stream.socket.recv(1)
