"""Ends asyncio servers."""

from __future__ import annotations

import asyncio

TURNS = 3
"""Turns of the event loop in which asyncio makes the transport and the protocol of a connection
that it has accepted."""


async def close(server: asyncio.Server) -> None:
    """Stops listening. Afterwards, every connection that was accepted has its protocol.

    `asyncio.Server.close` alone leaves a connection open that comes at the same time: its transport
    is refused half made, or made when nobody looks for it any more. On Windows, one that comes at
    this very moment may still be left to the garbage collector.
    """
    loop = asyncio.get_running_loop()
    try:
        for listening in server.sockets:
            loop.remove_reader(listening.fileno())
    except NotImplementedError:
        server.close()  # The event loop of Windows has no readers.
    for _ in range(TURNS):
        await asyncio.sleep(0)
    server.close()
