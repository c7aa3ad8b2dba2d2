"""Every operation of a client, with a docstring and types. Does no I/O.

Made from `async_operations.py`: change that one, then run `make format`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, SupportsIndex, overload

from holdfast._core import Request
from holdfast.client import identification, requests
from holdfast.client.base import BaseClient

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.client.fork import BlockingConnection
    from holdfast.client.identification import Identification
    from holdfast.client.requests import EventLog, Plan, Result, ServerId
    from holdfast.types import (
        Area,
        BoolType,
        ByteOrder,
        FloatType,
        Integers,
        IntegerType,
        ValueType,
    )


class SyncOperations(BaseClient):
    """The operations of a client; a subclass sets the transport."""

    __slots__ = ("_transport",)

    _transport: BlockingConnection

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
        write them in one step, but no request cuts an element of an array.
        """
        steps = requests.write_typed(area, address, value, type, order, encoding, split=split)
        self._run(steps, unit)

    def write_coil(self, address: int, value: SupportsIndex, *, unit: int | None = None) -> None:
        """Writes one coil (function 5)."""
        self._call(Request.write_coil(address, value), unit)

    def write_coils(
        self,
        address: int,
        values: Integers,
        *,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """Writes up to 1968 coils (function 15). With `split`, writes any number, in several
        requests that the device does not execute in one step.
        """
        self._run(requests.write_range("coils", address, values, split=split), unit)

    def write_register(
        self, address: int, value: SupportsIndex, *, unit: int | None = None
    ) -> None:
        """Writes one holding register (function 6), 0 to 65535."""
        self._call(Request.write_register(address, value), unit)

    def write_registers(
        self,
        address: int,
        values: Integers,
        *,
        split: bool = False,
        unit: int | None = None,
    ) -> None:
        """Writes up to 123 holding registers (function 16). With `split`, writes any number, in
        several requests that the device does not execute in one step.
        """
        self._run(requests.write_range("holding_registers", address, values, split=split), unit)

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
        values: Integers,
        *,
        unit: int | None = None,
    ) -> list[int]:
        """Writes up to 121 holding registers, then reads up to 125, as one step (function 23)."""
        request = Request.read_write(read_address, count, write_address, values)
        return self._run(request, unit)

    def identify(self, *, unit: int | None = None) -> Identification:
        """Reads all identification objects of the device (function 43/14)."""
        return self._run(identification.identify(), unit)

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
        return self._run(Request.event_counter(), unit)

    def event_log(self, *, unit: int | None = None) -> EventLog:
        """Reads the counts and the event log of a device on a serial line (function 12)."""
        return requests.EventLog(*self._call(Request.event_log(), unit))

    def read_exception_status(self, *, unit: int | None = None) -> int:
        """Reads eight outputs whose meaning depends on the device, as one byte (function 7)."""
        return self._run(Request.exception_status(), unit)

    def read_file_record(
        self, file: int, record: int, count: int = 1, *, unit: int | None = None
    ) -> list[int]:
        """Reads `count` records of a file, 0 to 65535 each (function 20). More than 121 take
        several requests.
        """
        return self._run(requests.read_file(file, record, count), unit)

    def read_file_records(
        self, ranges: Sequence[tuple[int, int, int]], *, unit: int | None = None
    ) -> list[list[int]]:
        """Reads ranges of records in one request (function 20): each is a file, the first record
        and the count. Returns the records of each range.
        """
        return self._run(Request.read_files(ranges), unit)

    def write_file_record(
        self, file: int, record: int, values: Integers, *, unit: int | None = None
    ) -> None:
        """Writes up to 122 records of a file from `record` on (function 21)."""
        self._call(Request.write_files([(file, record, values)]), unit)

    def write_file_records(
        self, ranges: Sequence[tuple[int, int, Integers]], *, unit: int | None = None
    ) -> None:
        """Writes ranges of records in one request (function 21): each is a file, the first record
        and the values.
        """
        self._call(Request.write_files(ranges), unit)

    def read_fifo_queue(self, address: int, *, unit: int | None = None) -> list[int]:
        """Reads the up to 31 registers of the queue at `address`, and leaves them there (function
        24).
        """
        return self._run(Request.read_queue(address), unit)

    def call_function(self, code: int, data: bytes = b"", *, unit: int | None = None) -> bytes:
        """Sends a request of any function, such as one of the device's own, and returns what the
        reply has after the function code. Never sent twice, unless it is a read of the standard.
        """
        return self._run(Request.of_function(code, data), unit)

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

    def _run(self, plan: Plan[Result], unit: int | None) -> Result:
        """Runs a plan."""
        if isinstance(plan, Request):
            result: Result = self._transport.call(plan, self.unit_for(plan, unit), self._timeout)
            return result
        return requests.carry_out(plan, lambda request: self._call(request, unit))

    def _call(self, request: Request, unit: int | None) -> Any:
        return self._transport.call(request, self.unit_for(request, unit), self._timeout)
