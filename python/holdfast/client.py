"""Clients of Modbus devices, over every transport: `Client` for asyncio, `SyncClient` without it.

Both have the same methods, carry out the same steps (`operations`) and know the same errors
(`errors`). This room must never poll.

A connection is made when it is needed, and kept. When it is lost, the calls that waited fail, and
the next one makes a new connection; no call is repeated.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Self

from holdfast import operations, tls
from holdfast._core import BlockingClient, Endpoint, Request
from holdfast.errors import ConnectionLost, ModbusException
from holdfast.link import CLOSED, Link
from holdfast.target import IN_FLIGHT, TLS_PORT, NetworkTarget, SerialTarget, parse

if TYPE_CHECKING:
    from collections.abc import Awaitable, Sequence
    from ssl import SSLContext

    from holdfast.operations import Identification, Plan, Result, ServerId, Steps
    from holdfast.target import Target, Tls
    from holdfast.types import Area

LONGEST_TIMEOUT = 86_400.0
MOST_IN_FLIGHT = 1024

BROADCASTS = (5, 6, 15, 16, 22)
"""The functions that may be sent to all units of a serial line (V1.02, 2.1)."""


class _Common:
    """What both clients are made of."""

    def __init__(self, url: str, unit: int, timeout: float) -> None:
        self.target = parse(url)
        self.unit = _unit(unit)
        self.timeout = _timeout(timeout)

    def _unit_for(self, request: Request, unit: int | None) -> int:
        unit = self.unit if unit is None else _unit(unit)
        if unit == 0 and isinstance(self.target, SerialTarget):
            code = request.pdu[0]
            if code not in BROADCASTS:
                raise ValueError(
                    f"unit 0 of a serial line is the broadcast, not for function {code}"
                )
        return unit


class SyncClient(_Common):
    """A client that waits: every method returns when the device has answered.

    `url` names the device: `tcp://host:502`, `tls://host:802?ca=ca.pem`, `udp://host:502`,
    `rtu+tcp://host:502`, `rtu:///dev/ttyUSB0?baud=19200&parity=even` or `ascii:///dev/ttyUSB0`.
    `unit` is the unit id, 0 to 255, that a call can replace. `timeout` in seconds covers
    connecting, sending and receiving.

    The files of a `tls` URL are read now: `OSError` and `ValueError` say what is wrong with them.

    Threads may share a client; their calls take turns, for which `timeout` does not count.

    Methods raise `ValueError` or `TypeError` before anything is sent, and `ModbusException`,
    `ConnectionLost`, `RequestTimeout` or `InvalidResponse` after; all four are `ModbusError`.

    >>> with holdfast.SyncClient("tcp://plc") as plc:
    ...     plc.read_holding_registers(0, 3)
    [11, 22, 33]
    """

    def __init__(self, url: str, *, unit: int = 1, timeout: float = 1.0) -> None:
        super().__init__(url, unit, timeout)
        self._core = blocking(self.target)

    def read_coils(self, address: int, count: int, *, unit: int | None = None) -> list[bool]:
        """`count` coils (function 1); more than 2000 take several requests."""
        return self._run(operations.read_range("coils", address, count), unit)

    def read_discrete_inputs(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[bool]:
        """`count` discrete inputs (function 2); more than 2000 take several requests."""
        return self._run(operations.read_range("discrete_inputs", address, count), unit)

    def read_holding_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """`count` holding registers (function 3), 0 to 65535 each; more than 125 take several
        requests.
        """
        return self._run(operations.read_range("holding_registers", address, count), unit)

    def read_input_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """`count` input registers (function 4), 0 to 65535 each; more than 125 take several
        requests.
        """
        return self._run(operations.read_range("input_registers", address, count), unit)

    def read(
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
        steps = operations.read_typed(area, address, type, order, encoding)
        return self._run(steps, unit)

    def write(
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
        steps = operations.write_typed(area, address, value, type, order, encoding, split=split)
        self._run(steps, unit)

    def write_coil(self, address: int, value: bool, *, unit: int | None = None) -> None:
        """One coil (function 5)."""
        self._call(Request.write_coil(address, value), unit)

    def write_coils(
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
        self._run(operations.write_range("coils", address, values, split=split), unit)

    def write_register(self, address: int, value: int, *, unit: int | None = None) -> None:
        """One holding register (function 6), 0 to 65535."""
        self._call(Request.write_register(address, value), unit)

    def write_registers(
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
        steps = operations.write_range("holding_registers", address, values, split=split)
        self._run(steps, unit)

    def mask_write(
        self, address: int, *, and_mask: int, or_mask: int, unit: int | None = None
    ) -> None:
        """Sets a holding register to `(now & and_mask) | (or_mask & ~and_mask)` (function 22)."""
        self._call(Request.mask_write(address, and_mask, or_mask), unit)

    def read_write(
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
        result: list[int] = self._call(request, unit)
        return result

    def identify(self, *, unit: int | None = None) -> Identification:
        """What the device says of itself (function 43/14): all objects that it has."""
        return self._run(operations.identify(), unit)

    def report_server_id(self, *, unit: int | None = None) -> ServerId:
        """What the device says of itself by function 17."""
        return operations.ServerId(self._call(Request.report_server_id(), unit))

    def diagnostics(
        self, sub_function: int, data: Sequence[int] = (0,), *, unit: int | None = None
    ) -> list[int]:
        """Diagnostics (function 8): sends data words to a sub-function, returns those that come.

        Sub-function 4, Force Listen Only Mode, has no reply: it ends in a `RequestTimeout`.
        """
        return self._run(operations.diagnostics(sub_function, data), unit)

    def event_counter(self, *, unit: int | None = None) -> tuple[bool, int]:
        """Whether the device is busy, and how many requests it carried out (function 11)."""
        result: tuple[bool, int] = self._call(Request.event_counter(), unit)
        return result

    @property
    def late(self) -> int:
        """Replies that came after their requests had timed out, and were dropped."""
        return self._core.late

    def close(self) -> None:
        """Ends the connection after the calls that came before. A later call makes a new one."""
        self._core.close()

    def _run(self, plan: Plan[Result], unit: int | None) -> Result:
        """Carries out a plan."""
        if isinstance(plan, Request):
            result: Result = self._call(plan, unit)
            return result
        try:
            request = next(plan)
            while True:
                try:
                    reply = self._call(request, unit)
                except ModbusException as error:
                    request = plan.throw(error)
                else:
                    request = plan.send(reply)
        except StopIteration as end:
            value: Result = end.value
            return value

    def _call(self, request: Request, unit: int | None) -> Any:
        return self._core.call(request, self._unit_for(request, unit), self.timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Client(_Common):
    """A client for asyncio: every method is awaited.

    `url`, `unit` and `timeout` are those of `SyncClient`, and so are the errors. Over TCP and TLS
    up to `max_in_flight` requests are on their way at once, and replies may come in any order; what
    is more waits for its turn, which `timeout` does not cover. Give 1 for a device that answers
    only one at a time. On other transports one request is on its way at once.

    Any number of tasks may share a client, in one event loop; in another one after `close`, or
    when the first is closed. A call that is cancelled leaves the connection usable.

    >>> async with holdfast.Client("tcp://plc") as plc:
    ...     await plc.read("holding_registers", 100, "float32", order="CDAB")
    21.5
    """

    def __init__(
        self, url: str, *, unit: int = 1, timeout: float = 1.0, max_in_flight: int = 16
    ) -> None:
        super().__init__(url, unit, timeout)
        if type(max_in_flight) is not int or not 1 <= max_in_flight <= MOST_IN_FLIGHT:
            raise ValueError(
                f"max_in_flight is {max_in_flight!r}, allowed are 1 to {MOST_IN_FLIGHT}"
            )
        self._transport: Link | _Thread
        if isinstance(self.target, NetworkTarget) and self.target.transport in IN_FLIGHT:
            self._transport = Link(self.target, max_in_flight, _context(self.target))
        else:
            self._transport = _Thread(self.target)

    async def read_coils(self, address: int, count: int, *, unit: int | None = None) -> list[bool]:
        """`count` coils (function 1); more than 2000 take several requests."""
        return await self._run(operations.read_range("coils", address, count), unit)

    async def read_discrete_inputs(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[bool]:
        """`count` discrete inputs (function 2); more than 2000 take several requests."""
        return await self._run(operations.read_range("discrete_inputs", address, count), unit)

    async def read_holding_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """`count` holding registers (function 3), 0 to 65535 each; more than 125 take several
        requests.
        """
        return await self._run(operations.read_range("holding_registers", address, count), unit)

    async def read_input_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """`count` input registers (function 4), 0 to 65535 each; more than 125 take several
        requests.
        """
        return await self._run(operations.read_range("input_registers", address, count), unit)

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
        steps = operations.read_typed(area, address, type, order, encoding)
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
        steps = operations.write_typed(area, address, value, type, order, encoding, split=split)
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
        await self._run(operations.write_range("coils", address, values, split=split), unit)

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
            operations.write_range("holding_registers", address, values, split=split), unit
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
        return await self._run(operations.identify(), unit)

    async def report_server_id(self, *, unit: int | None = None) -> ServerId:
        """What the device says of itself by function 17."""
        return operations.ServerId(await self._call(Request.report_server_id(), unit))

    async def diagnostics(
        self, sub_function: int, data: Sequence[int] = (0,), *, unit: int | None = None
    ) -> list[int]:
        """Diagnostics (function 8): sends data words to a sub-function, returns those that come.

        Sub-function 4, Force Listen Only Mode, has no reply: it ends in a `RequestTimeout`.
        """
        return await self._run(operations.diagnostics(sub_function, data), unit)

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
                except ModbusException as error:
                    request = steps.throw(error)
                else:
                    request = steps.send(reply)
        except StopIteration as end:
            value: Result = end.value
            return value

    def _call(self, request: Request, unit: int | None) -> Awaitable[Any]:
        return self._transport.call(request, self._unit_for(request, unit), self.timeout)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class _Thread:
    """A transport that carries one request at a time, in a thread of its own."""

    def __init__(self, target: Target) -> None:
        self._core = blocking(target)
        self._executor: ThreadPoolExecutor | None = None

    async def call(self, request: Request, unit: int, timeout: float) -> Any:
        """Sends a request when its turn has come, and waits for the result."""
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, "holdfast-client")
        loop = asyncio.get_running_loop()
        executor = self._executor
        return await loop.run_in_executor(executor, self._carry, executor, request, unit, timeout)

    def _carry(
        self, executor: ThreadPoolExecutor, request: Request, unit: int, timeout: float
    ) -> Any:
        if executor is not self._executor:
            raise ConnectionLost(CLOSED)
        return self._core.call(request, unit, timeout)

    async def close(self) -> None:
        """Ends the connection, once the call under way has ended; those that wait fail."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.submit(self._core.close)
            await asyncio.to_thread(executor.shutdown)

    @property
    def late(self) -> int:
        """Replies that came too late."""
        return self._core.late


def blocking(target: Target) -> BlockingClient:
    """The native client of a target; it connects when it is first used."""
    return BlockingClient(endpoint(target))


def endpoint(target: Target) -> Endpoint:
    """A target as the native core has it."""
    if isinstance(target, SerialTarget):
        return Endpoint.serial(
            target.device,
            mode=target.mode,
            baud=target.baud,
            parity=target.parity,
            stop_bits=target.stop_bits,
            data_bits=target.data_bits,
            silence=target.silence,
            echo=target.echo,
        )
    if target.transport == "tls":
        of = target.tls
        return Endpoint.tls(target.host, target.port, of.ca, of.cert, of.key, of.name)
    return Endpoint.network(target.transport, target.host, target.port)


def _context(target: NetworkTarget) -> SSLContext | None:
    """What asyncio needs to know of TLS, if the target has it."""
    if target.transport != "tls":
        return None
    endpoint(target)  # It says what is wrong with files and names, as in the other client.
    return tls.context(target.tls)


def check_files(tls: Tls) -> None:
    """Raises `OSError` and `ValueError` for files that can't be used."""
    _context(NetworkTarget("tls", "localhost", TLS_PORT, tls))


def _unit(unit: int) -> int:
    if type(unit) is not int or not 0 <= unit <= 255:
        raise ValueError(f"unit is {unit!r}, allowed are 0 to 255")
    return unit


def _timeout(seconds: float) -> float:
    if not 0 < seconds <= LONGEST_TIMEOUT:
        raise ValueError(f"timeout is {seconds!r}, allowed are more than 0 to 86400 seconds")
    return float(seconds)
