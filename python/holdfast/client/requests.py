"""The operations of a client: single requests, or steps that yield requests and receive results.

Both clients run the same steps. This module does no I/O. Arguments are checked when a request is
built, before anything is sent.
"""

from __future__ import annotations

import contextlib
from collections.abc import Awaitable, Callable, Generator
from dataclasses import dataclass
from operator import index
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from holdfast._core import Request
from holdfast.errors import ModbusError
from holdfast.protocol import (
    ADDRESSES,
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    LAST_ADDRESS,
    MAX_WORD,
    READ_LIMITS,
    READ_RECORDS,
    WRITE_LIMITS,
)
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing
from holdfast.types import AREAS, BIT_AREAS, SHORT_AREAS, WRITABLE_AREAS
from holdfast.values.codec import codec_for
from holdfast.values.errors import UnknownType
from holdfast.values.types import whole_elements

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.types import Area, Integers

Sent = TypeVar("Sent")
Result = TypeVar("Result")
Steps: TypeAlias = Generator[Request, Any, Result]
Plan: TypeAlias = Request | Steps[Result]
"""One request whose result is the result of the operation, or steps."""


def carry_out(steps: Generator[Sent, Any, Result], answer: Callable[[Sent], Any]) -> Result:
    """Carries out steps: what they yield gets its answer, or the `ModbusError` of it."""
    try:
        request = next(steps)
        while True:
            try:
                reply = answer(request)
            except ModbusError as error:
                request = steps.throw(error)
            else:
                request = steps.send(reply)
    except StopIteration as end:
        result: Result = end.value
        return result


async def carry_out_async(
    steps: Generator[Sent, Any, Result], answer: Callable[[Sent], Awaitable[Any]]
) -> Result:
    """As `carry_out`, and waits for each answer."""
    try:
        request = next(steps)
        while True:
            try:
                reply = await answer(request)
            except ModbusError as error:
                request = steps.throw(error)
            else:
                request = steps.send(reply)
    except StopIteration as end:
        result: Result = end.value
        return result


REFUSALS = (ILLEGAL_ADDRESS, ILLEGAL_VALUE)
"""Exceptions of a device that does not have a category."""


@dataclass(frozen=True)
class ServerId:
    """The answer to function 17. Its layout depends on the device."""

    data: bytes
    """The whole answer."""

    @property
    def server_id(self) -> int | None:
        """The first byte, which most devices use as an id."""
        return self.data[0] if self.data else None

    @property
    def running(self) -> bool | None:
        """The run indicator in the second byte; `None` if it is neither 0x00 nor 0xFF."""
        return {0xFF: True, 0x00: False}.get(self.data[1]) if len(self.data) > 1 else None

    @property
    def additional(self) -> bytes:
        """The bytes after the run indicator."""
        return self.data[2:]


@dataclass(frozen=True)
class EventLog:
    """The answer to function 12."""

    busy: bool
    """Whether the device still processes a program command."""
    events: int
    """Requests that the device has carried out, as function 11 counts them."""
    messages: int
    """Messages that the device has received."""
    log: bytes
    """One byte for each event, the latest first (V1.1b3, 6.10)."""


def read_range(area: Area, address: int, count: int, element: int = 1) -> Plan[list[Any]]:
    """Reads `count` bits or registers, in several requests if necessary.

    These end where an element ends, of `element` registers: a device may change values in between.
    """
    limit = READ_LIMITS.get(area)
    if limit is None or (type(count) is int and count <= limit):
        return Request.read(area, address, count)
    address, count = index(address), index(count)
    if count <= limit:
        return Request.read(area, address, count)
    size = whole_elements(limit, element)
    return _in_turn(
        [
            Request.read(area, start, min(size, address + count - start))
            for start in _starts(address, count, size)
        ]
    )


def _in_turn(reads: list[Request]) -> Steps[list[Any]]:
    whole: list[Any] = []
    for read in reads:
        whole += yield read
    return whole


def read_file_requests(file: int, record: int, count: int) -> list[Request]:
    """The requests that read records of a file. Raises `ValueError` for records that can't be."""
    first, count = index(record), index(count)
    starts = range(first, first + count, READ_RECORDS) or (first,)
    return [
        Request.read_files([(file, start, min(READ_RECORDS, first + count - start))])
        for start in starts
    ]


def read_file(file: int, record: int, count: int) -> Steps[list[int]]:
    """Reads records of a file, in several requests if necessary."""
    whole: list[int] = []
    for read in read_file_requests(file, record, count):
        [records] = yield read
        whole += records
    return whole


class TooManyValues(ValueError):
    """A write does not fit in one request, and `split` is not set."""

    def __init__(self, count: int, limit: int) -> None:
        super().__init__(count, limit)
        self.count = count
        self.limit = limit

    def __str__(self) -> str:
        return (
            f"{self.count} values, one request writes at most {self.limit}; use split=True for "
            "several requests, which the device does not execute in one step"
        )


def write_range(
    area: Area, address: int, items: Integers, element: int = 1, *, split: bool
) -> Steps[None]:
    """Writes bits or registers in one request, or with `split` in several.

    These end where an element ends, of `element` registers: a device may refuse any of them.
    """
    limit = WRITE_LIMITS[area]
    address = index(address)
    if not hasattr(items, "__len__"):
        raise TypeError(f"values are {type(items).__name__}, not a sequence of integers")
    make = Request.write_coils if area == "coils" else Request.write_registers
    if len(items) <= limit:
        yield make(address, items)
        return
    if not split:
        raise TooManyValues(len(items), limit)
    with contextlib.suppress(ValueError):  # There are too many items for one request.
        make(address, items)  # Refuses what is not a sequence of integers, such as a mapping.
    items = list(items)  # Not every sequence has slices.
    size = whole_elements(limit, element)
    starts = _starts(address, len(items), size)
    try:
        requests = [
            make(start, items[start - address : start - address + size]) for start in starts
        ]
    except ValueError:
        make(address, items)  # Its error has the index in all items.
        raise
    for start, request in zip(starts, requests, strict=True):
        try:
            yield request
        except ModbusError as error:
            if start > address:
                items_of = "coils" if area == "coils" else "registers"
                error.note_written(start - address, f"{len(items)} {items_of}")
            raise


def read_typed(area: Area, address: int, kind: str, order: str, encoding: str | None) -> Steps[Any]:
    """Reads a typed value, or an array of values."""
    _check_area(area, AREAS)
    if str(kind).isdigit() and area in READ_LIMITS:  # As other libraries are called, with a count.
        raise UnknownType(
            f"type is {kind}, allowed: the name of a type, as in 'uint16[{kind}]'; for {kind} "
            f"{'bits' if area in BIT_AREAS else 'registers'}, use read_{area}({address}, {kind})"
        )
    codec = codec_for(area, kind, order, encoding)
    plan = read_range(area, address, codec.type.registers, codec.type.width // 2)
    raw = (yield plan) if isinstance(plan, Request) else (yield from plan)
    return codec.unpack(codec.to_bytes(raw))


def write_typed(
    area: Area,
    address: int,
    value: Any,
    kind: str,
    order: str,
    encoding: str | None,
    *,
    split: bool,
) -> Steps[None]:
    """Writes a typed value: one bit or register with functions 5 and 6, several with 15 and 16; one
    bit of a register with function 22, which keeps the other bits.
    """
    _check_area(area, WRITABLE_AREAS)
    codec = codec_for(area, kind, order, encoding)
    raw = codec.encode(value)
    if codec.type.base == "bit":
        if codec.type.count is not None:
            raise ValueError(f"{kind} has bits of several registers, allowed: one bit")
        [mask] = raw
        yield Request.mask_write(address, *((MAX_WORD ^ mask, mask) if value else (mask, 0)))
    elif len(raw) > 1:
        yield from write_range(area, address, raw, codec.type.width // 2, split=split)
    elif area in BIT_AREAS:
        yield Request.write_coil(address, bool(raw[0]))
    else:
        yield Request.write_register(address, raw[0])


def _check_area(area: Area, allowed: Sequence[Area]) -> None:
    """Raises `ValueError` for an area that can't be read or written, or does not exist."""
    if area in allowed:
        return
    meant = SHORT_AREAS.get(str(area).lower(), area)
    raise ValueError(f"area is {area!r}, allowed: {listing(allowed)}{suggestion(meant, allowed)}")


def diagnostics(sub_function: int, data: Sequence[int]) -> Steps[list[int]]:
    """Sends and receives data words (function 8)."""
    reply: bytes = yield Request.diagnostics(sub_function, data)
    return [int.from_bytes(reply[at : at + 2], "big") for at in range(0, len(reply), 2)]


def _starts(address: int, count: int, limit: int) -> range:
    if not 0 <= address < ADDRESSES or address + count > ADDRESSES:
        raise ValueError(f"{count} from address {address}: the last address is {LAST_ADDRESS}")
    return range(address, address + count, limit)
