"""Sends a packet over plain TCP and receives the reply."""

from __future__ import annotations

import asyncio
import selectors
from typing import TYPE_CHECKING

from holdfast.client.connecting import left

if TYPE_CHECKING:
    import socket

    from holdfast.raw_ingest.outcome import Attempt


async def exchange(attempt: Attempt, connection: socket.socket, packet: bytes) -> bytes:
    """Sends the packet and returns the reply, empty without one.

    Waits for the reply from the start: a receiver can refuse a packet by its header. The rest of
    the packet does not matter then.
    """
    loop = asyncio.get_running_loop()
    attempt.connected = True
    sending = asyncio.create_task(loop.sock_sendall(connection, packet))
    try:
        return await loop.sock_recv(connection, 1)
    finally:
        sending.cancel()
        await asyncio.wait([sending])
        attempt.sent = not sending.cancelled() and sending.exception() is None


def exchange_sync(
    attempt: Attempt, connection: socket.socket, packet: bytes, deadline: float
) -> bytes:
    """Like `exchange`, without an event loop."""
    attempt.connected = True
    unsent = memoryview(packet)
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE)
        while True:
            for _, ready in selector.select(left(deadline)):
                try:
                    if ready & selectors.EVENT_READ:
                        return connection.recv(1)
                    unsent = unsent[connection.send(unsent) :]
                    attempt.sent = not unsent
                except BlockingIOError:
                    continue
                except OSError:
                    if ready & selectors.EVENT_READ:
                        raise
                    selector.modify(connection, selectors.EVENT_READ)
                if attempt.sent:
                    selector.modify(connection, selectors.EVENT_READ)
