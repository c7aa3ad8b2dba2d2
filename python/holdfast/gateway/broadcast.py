"""Broadcasts: writes to unit id 0 over RTU over TCP. Devices do not respond to them."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from holdfast.client.async_transports import connect_failed
from holdfast.errors import ConnectionLost, InvalidResponse
from holdfast.protocol import TURNAROUND_S
from holdfast.types import SERIAL_FRAMES

if TYPE_CHECKING:
    from holdfast._core import Request
    from holdfast.client.url import NetworkTarget
    from holdfast.types import Transport

NOTE = "the broadcast was sent; devices do not confirm broadcasts"


def is_broadcast(transport: Transport, unit: int) -> bool:
    """Whether devices do not respond to a request."""
    return unit == 0 and transport in SERIAL_FRAMES


async def send(target: NetworkTarget, request: Request) -> None:
    """Sends a broadcast on a connection of its own, and waits as long as devices may need."""
    try:
        reader, writer = await asyncio.open_connection(target.host, target.port)
    except OSError as error:
        raise connect_failed(target, error) from error
    try:
        writer.write(request.rtu_frame(0))
        await writer.drain()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TURNAROUND_S):
                _check_reply(await reader.read(256))
    except ConnectionError as error:
        raise ConnectionLost(f"connection lost: {error}") from None
    finally:
        writer.close()


def _check_reply(reply: bytes) -> None:
    """Raises a `ModbusError` if the peer closed the connection or sent an exception."""
    if not reply:
        raise ConnectionLost("connection lost: closed by the peer")
    if len(reply) > 1 and reply[1] & 0x80:
        raise InvalidResponse(f"the peer answered a broadcast with an exception: {reply.hex(' ')}")
