"""`Client`: a client for asyncio."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

from holdfast._core import Request
from holdfast.client import requests
from holdfast.client.base import BaseClient
from holdfast.client.connection import AsyncConnection
from holdfast.client.endpoint import endpoint
from holdfast.client.one_at_a_time import OneAtATime
from holdfast.client.target import IN_FLIGHT, MAX_IN_FLIGHT, NetworkTarget
from holdfast.errors import InvalidResponse, ModbusException

if TYPE_CHECKING:
    from collections.abc import Awaitable, Sequence

    from holdfast.client.requests import Identification, Plan, Result, ServerId, Steps
    from holdfast.types import Area


class Client(BaseClient):
    """A client for asyncio: every method is awaited.

    `url`, `unit` and `timeout` are those of `SyncClient`, and so are the errors. Over TCP and TLS
    up to `max_in_flight` requests are on their way at once, and replies may come in any order; what
    is more waits for its turn, which `timeout` does not cover. More than 1 is faster where a device
    accepts it; many drop requests that overlap. Each reply starts the timeouts of later requests
    again. On other transports one request is on its way at once.

    Any number of tasks may share a client, in one event loop; in another one after `close`, or
    when the first is closed. A call that is cancelled leaves the connection usable.

    >>> async with holdfast.Client("tcp://plc") as plc:
    ...     await plc.read("holding_registers", 100, "float32", order="CDAB")
    21.5
    """

    def __init__(
        self, url: str, *, unit: int = 1, timeout: float = 1.0, max_in_flight: int = 1
    ) -> None:
        super().__init__(url, unit, timeout)
        if type(max_in_flight) is not int or not 1 <= max_in_flight <= MAX_IN_FLIGHT:
            raise ValueError(
                f"max_in_flight is {max_in_flight!r}, allowed are 1 to {MAX_IN_FLIGHT}"
            )
        self._transport: AsyncConnection | OneAtATime
        if isinstance(self.target, NetworkTarget) and self.target.transport in IN_FLIGHT:
            self._transport = AsyncConnection(self.target, endpoint(self.target), max_in_flight)
        else:
            self._transport = OneAtATime(self.target)

    async def read_coils(self, address: int, count: int, *, unit: int | None = None) -> list[bool]:
        """`count` coils (function 1); more than 2000 take several requests."""
        return await self._run(requests.read_range("coils", address, count), unit)

    async def read_discrete_inputs(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[bool]:
        """`count` discrete inputs (function 2); more than 2000 take several requests."""
        return await self._run(requests.read_range("discrete_inputs", address, count), unit)

    async def read_holding_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """`count` holding registers (function 3), 0 to 65535 each; more than 125 take several
        requests.
        """
        return await self._run(requests.read_range("holding_registers", address, count), unit)

    async def read_input_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """`count` input registers (function 4), 0 to 65535 each; more than 125 take several
        requests.
        """
        return await self._run(requests.read_range("input_registers", address, count), unit)

    async def read(
        self,
        area: Area,
        address: int,
        type: str,
        order: str = "ABCD",
        *,
        encoding: str | None = None,
        unit: int | None = None,
    ) -> Any:
        """A typed value, as `holdfast.values.decode` makes it: `"float32"`, `"int16[10]"`.

        `order` is the order of bytes, `encoding` that of a `string:N`.
        """
        steps = requests.read_typed(area, address, type, order, encoding)
        return await self._run(steps, unit)

    async def write(
        self,
        area: Area,
        address: int,
        value: Any,
        type: str,
        order: str = "ABCD",
        *,
        encoding: str | None = None,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """A typed value, as `holdfast.values.encode` makes it, into coils or holding registers.

        One bit or register is written by function 5 or 6, more by 15 or 16, one bit of a register
        (`bit:3`) by 22. What does not fit into one request needs `split`, and is not one step on
        the device then.
        """
        steps = requests.write_typed(area, address, value, type, order, encoding, split=split)
        await self._run(steps, unit)

    async def write_coil(self, address: int, value: bool, *, unit: int | None = None) -> None:
        """One coil (function 5)."""
        await self._call(Request.write_coil(address, value), unit)

    async def write_coils(
        self,
        address: int,
        values: Sequence[bool],
        *,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """Coils (function 15): up to 1968, or with `split` any number by several requests, which
        the device does not carry out as one step.
        """
        await self._run(requests.write_range("coils", address, values, split=split), unit)

    async def write_register(self, address: int, value: int, *, unit: int | None = None) -> None:
        """One holding register (function 6), 0 to 65535."""
        await self._call(Request.write_register(address, value), unit)

    async def write_registers(
        self,
        address: int,
        values: Sequence[int],
        *,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """Holding registers (function 16): up to 123, or with `split` any number by several
        requests, which the device does not carry out as one step.
        """
        await self._run(
            requests.write_range("holding_registers", address, values, split=split), unit
        )

    async def mask_write(
        self, address: int, *, and_mask: int, or_mask: int, unit: int | None = None
    ) -> None:
        """Sets a holding register to `(now & and_mask) | (or_mask & ~and_mask)` (function 22)."""
        await self._call(Request.mask_write(address, and_mask, or_mask), unit)

    async def read_write(
        self,
        read_address: int,
        count: int,
        write_address: int,
        values: Sequence[int],
        *,
        unit: int | None = None,
    ) -> list[int]:
        """Writes up to 121 holding registers, then reads up to 125, as one step (function 23)."""
        request = Request.read_write(read_address, count, write_address, values)
        result: list[int] = await self._call(request, unit)
        return result

    async def identify(self, *, unit: int | None = None) -> Identification:
        """What the device says of itself (function 43/14): all objects that it has."""
        return await self._run(requests.identify(), unit)

    async def report_server_id(self, *, unit: int | None = None) -> ServerId:
        """What the device says of itself by function 17."""
        return requests.ServerId(await self._call(Request.report_server_id(), unit))

    async def diagnostics(
        self, sub_function: int, data: Sequence[int] = (0,), *, unit: int | None = None
    ) -> list[int]:
        """Diagnostics (function 8): sends data words to a sub-function, returns those that come.

        Sub-function 4, Force Listen Only Mode, has no reply: it ends in a `RequestTimeout`.
        """
        return await self._run(requests.diagnostics(sub_function, data), unit)

    async def event_counter(self, *, unit: int | None = None) -> tuple[bool, int]:
        """Whether the device is busy, and how many requests it carried out (function 11)."""
        result: tuple[bool, int] = await self._call(Request.event_counter(), unit)
        return result

    @property
    def late(self) -> int:
        """Replies that came after their requests had timed out, and were dropped."""
        return self._transport.late

    async def close(self) -> None:
        """Ends the connection: calls that wait get `ConnectionLost`, a later one connects anew."""
        await self._transport.close()

    def _run(self, plan: Plan[Result], unit: int | None) -> Awaitable[Result]:
        """Carries out a plan."""
        if isinstance(plan, Request):
            return self._call(plan, unit)
        return self._take(plan, unit)

    async def _take(self, steps: Steps[Result], unit: int | None) -> Result:
        """Takes steps."""
        try:
            request = next(steps)
            while True:
                try:
                    reply = await self._call(request, unit)
                except (ModbusException, InvalidResponse) as error:
                    request = steps.throw(error)
                else:
                    request = steps.send(reply)
        except StopIteration as end:
            value: Result = end.value
            return value

    def _call(self, request: Request, unit: int | None) -> Awaitable[Any]:
        return self._transport.call(request, self.unit_for(request, unit), self.timeout)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
