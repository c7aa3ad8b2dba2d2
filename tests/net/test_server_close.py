"""The end of asyncio servers, at the moment when a client connects."""

from __future__ import annotations

import asyncio
import gc
import socket
import sys

import pytest

from holdfast.net.server_close import TURNS, close


@pytest.mark.skipif(sys.platform == "win32", reason="asyncio does not tell what it has accepted")
@pytest.mark.parametrize("turns", range(2 * TURNS))
def test_a_connection_at_the_end_is_not_accepted_or_has_its_protocol(turns: int) -> None:
    async def connected() -> tuple[socket.socket, list[asyncio.Transport]]:
        made: list[asyncio.Transport] = []

        class Keeping(asyncio.Protocol):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                assert isinstance(transport, asyncio.Transport)
                made.append(transport)

        server = await asyncio.get_running_loop().create_server(Keeping, "127.0.0.1", 0)
        client = socket.create_connection(server.sockets[0].getsockname())
        for _ in range(turns):
            await asyncio.sleep(0)
        await close(server)
        for transport in made:
            transport.abort()
        await asyncio.sleep(0)
        return client, made

    client, made = asyncio.run(connected())
    gc.collect()  # A transport that was left open would be an error.
    assert len(made) <= 1
    with client:
        client.settimeout(10)
        try:
            ended = client.recv(1)
        except ConnectionResetError:
            ended = b""
    assert ended == b""
