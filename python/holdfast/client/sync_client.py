"""`SyncClient`: a client without asyncio."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self, overload

from holdfast._core import Request
from holdfast.client import requests
from holdfast.client.base import BaseClient
from holdfast.client.endpoint import blocking
from holdfast.errors import InvalidResponse, ModbusException

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.client.requests import Identification, Plan, Result, ServerId
    from holdfast.types import Area, BoolType, ByteOrder, FloatType, IntegerType, ValueType


class SyncClient(BaseClient):
    """A blocking client: every method returns when the device has answered.

    `url` names the device: `tcp://host:502`, `tls://host:802?ca=ca.pem`, `udp://host:502`,
    `rtu+tcp://host:502`, `rtu+udp://host:502`, `ascii+tcp://host:502`,
    `rtu:///dev/ttyUSB0?baud=19200&parity=even` or `ascii:///dev/ttyUSB0`, with options for a device
    that deviates from the standard. `unit` is the unit id, 0 to 255, that a call can replace.
    `timeout` in seconds covers connecting, sending and receiving.

    Reads the files of a `tls` URL now; raises `OSError` or `ValueError` if they can't be used.

    A read is sent again when a connection that was used before ends without a byte of the reply,
    and as often as `retries` of the URL says. A write is never sent twice.

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
        """Reads `count` coils (function 1). More than 2000 take several requests."""
        return self._run(requests.read_range("coils", address, count), unit)

    def read_discrete_inputs(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[bool]:
        """Reads `count` discrete inputs (function 2). More than 2000 take several requests."""
        return self._run(requests.read_range("discrete_inputs", address, count), unit)

    def read_holding_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """Reads `count` holding registers (function 3), 0 to 65535 each. More than 125 take several
        requests.
        """
        return self._run(requests.read_range("holding_registers", address, count), unit)

    def read_input_registers(
        self, address: int, count: int, *, unit: int | None = None
    ) -> list[int]:
        """Reads `count` input registers (function 4), 0 to 65535 each. More than 125 take several
        requests.
        """
        return self._run(requests.read_range("input_registers", address, count), unit)

    @overload
    def read(
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
    def read(
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
    def read(
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
    def read(
        self,
        area: Area,
        address: int,
        type: ValueType,
        order: ByteOrder = "ABCD",
        *,
        encoding: str | None = None,
        unit: int | None = None,
    ) -> Any: ...
    def read(
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
        return self._run(steps, unit)

    def write(
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
        self._run(steps, unit)

    def write_coil(self, address: int, value: bool, *, unit: int | None = None) -> None:
        """Writes one coil (function 5)."""
        self._call(Request.write_coil(address, value), unit)

    def write_coils(
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
        self._run(requests.write_range("coils", address, values, split=split), unit)

    def write_register(self, address: int, value: int, *, unit: int | None = None) -> None:
        """Writes one holding register (function 6), 0 to 65535."""
        self._call(Request.write_register(address, value), unit)

    def write_registers(
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
        steps = requests.write_range("holding_registers", address, values, split=split)
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
        """Reads all identification objects of the device (function 43/14)."""
        return self._run(requests.identify(), unit)

    def report_server_id(self, *, unit: int | None = None) -> ServerId:
        """Reads the server id of the device (function 17)."""
        return requests.ServerId(self._call(Request.report_server_id(), unit))

    def diagnostics(
        self, sub_function: int, data: Sequence[int] = (0,), *, unit: int | None = None
    ) -> list[int]:
        """Sends data words to a diagnostics sub-function (function 8), and returns the reply's.

        Sub-function 4, Force Listen Only Mode, has no reply and raises `RequestTimeout`.
        """
        return self._run(requests.diagnostics(sub_function, data), unit)

    def event_counter(self, *, unit: int | None = None) -> tuple[bool, int]:
        """Returns whether the device is busy, and its count of completed requests (function 11)."""
        result: tuple[bool, int] = self._call(Request.event_counter(), unit)
        return result

    @property
    def late(self) -> int:
        """How many replies were dropped because they arrived after the timeout."""
        return self._core.late

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of these replies took; 0 if there were none.

        At most four times the timeout: what comes even later counts as that.
        """
        return self._core.longest_late

    def close(self) -> None:
        """Closes the connection after the calls before it. A later call reconnects."""
        self._core.close()

    def _run(self, plan: Plan[Result], unit: int | None) -> Result:
        """Runs a plan."""
        if isinstance(plan, Request):
            result: Result = self._call(plan, unit)
            return result
        try:
            request = next(plan)
            while True:
                try:
                    reply = self._call(request, unit)
                except (ModbusException, InvalidResponse) as error:
                    request = plan.throw(error)
                else:
                    request = plan.send(reply)
        except StopIteration as end:
            value: Result = end.value
            return value

    def _call(self, request: Request, unit: int | None) -> Any:
        return self._core.call(request, self.unit_for(request, unit), self.timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
