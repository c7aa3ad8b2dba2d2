"""`Client`, for asyncio."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from holdfast._core import MAX_IN_FLIGHT
from holdfast.client.async_operations import AsyncOperations
from holdfast.client.async_transports import AsyncConnection, ThreadedConnection
from holdfast.client.base import DEFAULT_TIMEOUT_S
from holdfast.client.endpoint import endpoint
from holdfast.client.url import IN_FLIGHT, NetworkTarget
from holdfast.values.integers import as_integer

if TYPE_CHECKING:
    from holdfast.client.async_transports import OwnTransport
    from holdfast.client.base import Trace
    from holdfast.client.url import Target


def connection(target: Target, max_in_flight: int, trace: Trace | None = None) -> OwnTransport:
    """The connection to a device, for asyncio. It connects on its first call."""
    if isinstance(target, NetworkTarget) and target.transport in IN_FLIGHT:
        return AsyncConnection(target, endpoint(target), max_in_flight, trace)
    return ThreadedConnection(target, trace)


class Client(AsyncOperations):
    """A client for asyncio. Await every method.

    `url`, `unit`, `timeout` and `trace` are those of `SyncClient`, and so are the errors. Over TCP
    and TLS up to `max_in_flight` requests are on their way at once, and replies may come in any
    order; what is more waits for its turn, which `timeout` does not cover. More than 1 is faster
    where a device accepts it; many drop requests that overlap. Each reply starts the timeouts of
    later requests again. On other transports one request is on its way at once, and a thread of the
    client calls `trace`.

    Any number of tasks can share a client in one event loop. To use it in another loop, first
    `close` it or close the first loop. After a cancelled call, the connection remains usable.

    >>> async with holdfast.Client("tcp://plc") as plc:
    ...     await plc.read("holding_registers", 100, "float32", order="CDAB")
    21.5
    """

    __slots__ = ()

    def __init__(
        self,
        url: str,
        *,
        unit: int = 1,
        timeout: float = DEFAULT_TIMEOUT_S,
        max_in_flight: int = 1,
        trace: Trace | None = None,
    ) -> None:
        super().__init__(url, unit, timeout)
        most = as_integer(max_in_flight)
        if most is None or not 1 <= most <= MAX_IN_FLIGHT:
            raise ValueError(f"max_in_flight is {max_in_flight!r}, allowed: 1 to {MAX_IN_FLIGHT}")
        self._transport = connection(self._target, most, trace)

    async def close(self) -> None:
        """Closes the connection: pending calls raise `ConnectionLost`, a later call reconnects."""
        await self._transport.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
