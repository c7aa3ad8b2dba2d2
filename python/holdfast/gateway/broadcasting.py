"""Broadcasts: writes to unit id 0 over RTU over TCP. Devices do not respond to them."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.client import Client
from holdfast.client.asyncio_connection import explained
from holdfast.client.url import NetworkTarget
from holdfast.errors import ConnectFailed, ConnectionLost, InvalidResponse
from holdfast.gateway.sharing import SharedClient

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast._core import Request

Result = TypeVar("Result")

TURNAROUND = 0.1
"""Seconds for devices to carry out a broadcast (Modbus over Serial Line V1.02, section 2.4.1)."""

NOTE = "the broadcast was sent; devices do not confirm broadcasts"


def broadcast(
    call: Callable[[Client], Awaitable[Result]],
) -> Callable[[Client], Awaitable[Result]]:
    """Wraps a call so that it only sends the request, on a new or on the shared connection."""

    async def send(client: Client) -> Result:
        if isinstance(client, SharedClient):
            client.broadcasts()
            return await call(client)
        await client.close()  # The peer may accept only one connection.
        assert isinstance(client.target, NetworkTarget)
        return await call(_Broadcaster(client.target))

    return send


class _Broadcaster(Client):
    """A client that does not wait for a response."""

    def __init__(self, target: NetworkTarget) -> None:
        super().__init__(str(target))
        self._at = target

    async def _call(self, request: Request, unit: int | None) -> Any:
        assert unit == 0
        target = self._at
        try:
            reader, writer = await asyncio.open_connection(target.host, target.port)
        except OSError as error:
            raise ConnectFailed(str(target), explained(error)) from error
        try:
            writer.write(request.rtu_frame(unit))
            await writer.drain()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TURNAROUND):
                    _judge(await reader.read(256))
        except ConnectionError as error:
            raise ConnectionLost(f"connection lost: {error}") from None
        finally:
            writer.close()


def _judge(reply: bytes) -> None:
    """Raises a `ModbusError` if the peer closed the connection or sent an exception."""
    if not reply:
        raise ConnectionLost("connection lost: closed by the peer")
    if len(reply) > 1 and reply[1] & 0x80:
        raise InvalidResponse(f"the peer answered a broadcast with an exception: {reply.hex(' ')}")
