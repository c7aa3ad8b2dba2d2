"""Broadcasts: writes to unit id 0 of a serial line. Devices do not respond to them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.errors import InvalidResponse, ModbusException, RequestTimeout
from holdfast.types import SERIAL_FRAMES

if TYPE_CHECKING:
    from holdfast._core import Request
    from holdfast.client.async_transports import AsyncTransport
    from holdfast.types import Transport

NOTE = "the broadcast was sent; devices do not confirm broadcasts"

LONGEST_S = 0.5
"""As over the appliance's connections: the time to connect, and for devices to carry it out.
A slower connection has the rest of the caller's time."""


def is_broadcast(transport: Transport, unit: int) -> bool:
    """Whether devices do not respond to a request."""
    return unit == 0 and transport in SERIAL_FRAMES


async def send(transport: AsyncTransport, request: Request, timeout: float) -> None:
    """Sends a broadcast on a new connection, and waits as long as devices may need.

    The caller's own timeout does not expire first: that would be an error.
    """
    short = min(timeout / 2, LONGEST_S)
    try:
        try:
            await transport.call(request, 0, short)
        except RequestTimeout as error:
            left = timeout - 2 * short
            if error.maybe_sent or left <= 0:
                raise
            await transport.call(request, 0, left)  # The connection is slow.
    except RequestTimeout as error:
        if not error.maybe_sent:
            raise
    except InvalidResponse:
        pass  # A device confirms it, with its own unit id.
    except ModbusException as error:
        raise InvalidResponse(f"the peer answered a broadcast with {error}") from None
    finally:
        await transport.close()
