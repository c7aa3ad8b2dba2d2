"""Broadcasts: writes to unit id 0 of a serial line behind RTU over TCP, which nobody answers."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.client import Client
from holdfast.client.connection import explained
from holdfast.client.target import NetworkTarget
from holdfast.errors import ConnectFailed, ConnectionLost, InvalidResponse

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast._core import Request

Result = TypeVar("Result")

TURNAROUND = 0.1
"""Seconds that devices get to carry a broadcast out (Modbus over Serial Line V1.02, 2.4.1)."""

NOTE = "a broadcast is sent, and nobody confirms it"


def broadcast(
    call: Callable[[Client], Awaitable[Result]],
) -> Callable[[Client], Awaitable[Result]]:
    """The same call, of which only the request is sent, on a connection of its own."""

    async def send(client: Client) -> Result:
        await client.close()  # The other side may take one connection only.
        assert isinstance(client.target, NetworkTarget)
        return await call(_Broadcaster(client.target))

    return send


class _Broadcaster(Client):
    """A client that waits for no reply."""

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
            body = bytes([unit]) + request.pdu
            writer.write(body + crc(body))
            await writer.drain()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TURNAROUND):
                    _judge(await reader.read(256))
        except ConnectionError as error:
            raise ConnectionLost(f"connection lost: {error}") from None
        finally:
            writer.close()


def _judge(reply: bytes) -> None:
    """Raises a `ModbusError` if the other side ended the connection, or sent an exception."""
    if not reply:
        raise ConnectionLost("connection lost: closed by the peer")
    if len(reply) > 1 and reply[1] & 0x80:
        raise InvalidResponse(f"a broadcast was answered with an exception: {reply.hex(' ')}")


def crc(body: bytes) -> bytes:
    """The CRC of an RTU frame, low byte first (Modbus over Serial Line V1.02, 6.2.2)."""
    remainder = 0xFFFF
    for byte in body:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder >> 1 ^ (0xA001 if remainder & 1 else 0)
    return remainder.to_bytes(2, "little")
