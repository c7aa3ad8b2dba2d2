"""`Client`: a client for asyncio."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self, overload

from holdfast._core import Request
from holdfast.client import requests
from holdfast.client.asyncio_connection import AsyncConnection
from holdfast.client.base import BaseClient
from holdfast.client.endpoint import endpoint
from holdfast.client.one_at_a_time import OneAtATime
from holdfast.client.url import IN_FLIGHT, MAX_IN_FLIGHT, NetworkTarget
from holdfast.errors import InvalidResponse, ModbusException
from holdfast.integers import as_integer

if TYPE_CHECKING:
    from collections.abc import Awaitable, Sequence
    from typing import Protocol

    from holdfast.client.requests import Identification, Plan, Result, ServerId, Steps
    from holdfast.types import Area, BoolType, ByteOrder, FloatType, IntegerType, ValueType

    class Transport(Protocol):
        """Carries calls to a device."""

        def call(self, request: Request, unit: int, timeout: float) -> Awaitable[Any]:
            """Sends a request, and waits for the result."""
            ...

        async def close(self) -> None:
            """Closes the connection."""
            ...

        @property
        def late(self) -> int:
            """How many replies arrived after their timeout."""

        @property
        def longest_late(self) -> float:
            """How many seconds the slowest of them took; 0 if there were none."""
            ...


class Client(BaseClient):
    """A client for asyncio. Await every method.

    `url`, `unit` and `timeout` are those of `SyncClient`, and so are the errors. Over TCP and TLS
    up to `max_in_flight` requests are on their way at once, and replies may come in any order; what
    is more waits for its turn, which `timeout` does not cover. More than 1 is faster where a device
    accepts it; many drop requests that overlap. Each reply starts the timeouts of later requests
    again. On other transports one request is on its way at once.

    Any number of tasks can share a client in one event loop. To use it in another loop, first
    `close` it or close the first loop. After a cancelled call, the connection remains usable.

    >>> async with holdfast.Client("tcp://plc") as plc:
    ...     await plc.read("holding_registers", 100, "float32", order="CDAB")
    21.5
    """

    def __init__(
        self, url: str, *, unit: int = 1, timeout: float = 1.0, max_in_flight: int = 1
    ) -> None:
        super().__init__(url, unit, timeout)
        most = as_integer(max_in_flight)
        if most is None or not 1 <= most <= MAX_IN_FLIGHT:
            raise ValueError(f"max_in_flight is {max_in_flight!r}, allowed: 1 to {MAX_IN_FLIGHT}")
        self._transport: Transport
        if isinstance(self.target, NetworkTarget) and self.target.transport in IN_FLIGHT:
            self._transport = AsyncConnection(self.target, endpoint(self.target), most)
        else:
            self._transport = OneAtATime(self.target)

    async def read_coils(self, address: int, count: int, *, unit: int | None = None) -> list[bool]:
        """Reads `count` coils (function 1). More than 2000 take several requests."""
        return await self._run(requests.read_range("coils", address, count), unit)

    async def read_discrete_inputs(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[bool]:
        """Reads `count` discrete inputs (function 2). More than 2000 take several requests."""
        return await self._run(requests.read_range("discrete_inputs", address, count), unit)

    async def read_holding_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """Reads `count` holding registers (function 3), 0 to 65535 each. More than 125 take several
        requests.
        """
        return await self._run(requests.read_range("holding_registers", address, count), unit)

    async def read_input_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """Reads `count` input registers (function 4), 0 to 65535 each. More than 125 take several
        requests.
        """
        return await self._run(requests.read_range("input_registers", address, count), unit)

    @overload
    async def read(
        self,
        area: Area,
        address: int,
        type: BoolType,
        order: ByteOrder = "ABCD",
        *,
        encoding: str | None = None,
        unit: int | None = None,
    ) -> bool: ...
    @overload
    async def read(
        self,
        area: Area,
        address: int,
        type: IntegerType,
        order: ByteOrder = "ABCD",
        *,
        encoding: str | None = None,
        unit: int | None = None,
    ) -> int: ...
    @overload
    async def read(
        self,
        area: Area,
        address: int,
        type: FloatType,
        order: ByteOrder = "ABCD",
        *,
        encoding: str | None = None,
        unit: int | None = None,
    ) -> float: ...
    @overload
    async def read(
        self,
        area: Area,
        address: int,
        type: ValueType,
        order: ByteOrder = "ABCD",
        *,
        encoding: str | None = None,
        unit: int | None = None,
    ) -> Any: ...
    async def read(
        self,
        area: Area,
        address: int,
        type: ValueType,
        order: ByteOrder = "ABCD",
        *,
        encoding: str | None = None,
        unit: int | None = None,
    ) -> Any:
        """Reads a typed value, as `holdfast.values.decode` does: `"float32"`, `"int16[10]"`.

        `order` is the byte order, `encoding` the encoding of a `string:N`.
        """
        steps = requests.read_typed(area, address, type, order, encoding)
        return await self._run(steps, unit)

    async def write(
        self,
        area: Area,
        address: int,
        value: Any,
        type: ValueType,
        order: ByteOrder = "ABCD",
        *,
        encoding: str | None = None,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """Writes a typed value to coils or holding registers, as `holdfast.values.encode` does.

        Uses function 5 or 6 for one bit or register, 15 or 16 for several, and 22 for one bit of a
        register (`bit:3`). Values that exceed one request require `split`; the device then does not
        write them in one step.
        """
        steps = requests.write_typed(area, address, value, type, order, encoding, split=split)
        await self._run(steps, unit)

    async def write_coil(self, address: int, value: bool, *, unit: int | None = None) -> None:
        """Writes one coil (function 5)."""
        await self._call(Request.write_coil(address, value), unit)

    async def write_coils(
        self,
        address: int,
        values: Sequence[bool],
        *,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """Writes up to 1968 coils (function 15). With `split`, writes any number, in several
        requests that the device does not execute in one step.
        """
        await self._run(requests.write_range("coils", address, values, split=split), unit)

    async def write_register(self, address: int, value: int, *, unit: int | None = None) -> None:
        """Writes one holding register (function 6), 0 to 65535."""
        await self._call(Request.write_register(address, value), unit)

    async def write_registers(
        self,
        address: int,
        values: Sequence[int],
        *,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """Writes up to 123 holding registers (function 16). With `split`, writes any number, in
        several requests that the device does not execute in one step.
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
        """Reads all identification objects of the device (function 43/14)."""
        return await self._run(requests.identify(), unit)

    async def report_server_id(self, *, unit: int | None = None) -> ServerId:
        """Reads the server id of the device (function 17)."""
        return requests.ServerId(await self._call(Request.report_server_id(), unit))

    async def diagnostics(
        self, sub_function: int, data: Sequence[int] = (0,), *, unit: int | None = None
    ) -> list[int]:
        """Sends data words to a diagnostics sub-function (function 8), and returns the reply's.

        Sub-function 4, Force Listen Only Mode, has no reply and raises `RequestTimeout`.
        """
        return await self._run(requests.diagnostics(sub_function, data), unit)

    async def event_counter(self, *, unit: int | None = None) -> tuple[bool, int]:
        """Returns whether the device is busy, and its count of completed requests (function 11)."""
        result: tuple[bool, int] = await self._call(Request.event_counter(), unit)
        return result

    @property
    def late(self) -> int:
        """How many replies were dropped because they arrived after the timeout."""
        return self._transport.late

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of these replies took; 0 if there were none.

        At most four times the timeout: what comes even later counts as that.
        """
        return self._transport.longest_late

    async def close(self) -> None:
        """Closes the connection: pending calls raise `ConnectionLost`, a later call reconnects."""
        await self._transport.close()

    def _run(self, plan: Plan[Result], unit: int | None) -> Awaitable[Result]:
        """Runs a plan."""
        if isinstance(plan, Request):
            return self._call(plan, unit)
        return self._take(plan, unit)

    async def _take(self, steps: Steps[Result], unit: int | None) -> Result:
        """Runs the steps of a plan."""
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
