"""Constants of the standard: areas and addresses, functions and their limits, exceptions.

The native core defines them, and this module derives others. No other Python module repeats these
numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from holdfast import _core

if TYPE_CHECKING:
    from holdfast.types import Area, Transport

ADDRESSES = _core.ADDRESSES
"""Maximum number of addresses in an area."""

LAST_ADDRESS = ADDRESSES - 1
MAX_WORD = 0xFFFF
"""The largest value of a register, and of every other 16-bit field."""

MAX_UNIT = 0xFF
MAX_SERIAL_UNIT = 247
"""The largest unit id, and the largest on a serial line (V1.02, 2.2)."""

PRIVATE_OBJECTS = range(0x80, 0x100)
"""The object ids of an identification that are left to makers (V1.1b3, 6.21)."""

PORT = 502
TLS_PORT = 802
"""The default ports of Modbus over TCP and UDP, and over TLS."""


def usual_port(transport: Transport) -> int:
    """The default port of a transport."""
    return TLS_PORT if transport == "tls" else PORT


class Function(NamedTuple):
    """A function that Holdfast supports (V1.1b3, 6)."""

    code: int
    name: str
    writes: bool
    """Whether it changes bits or registers."""
    area: Area | None
    """The area that it accesses; `None` for functions of the device itself, of files and queues."""
    most_read: int
    """Maximum number of bits or registers that it reads, 0 if it reads none."""
    most_written: int


MAX_PDU = _core.MAX_PDU
"""Maximum size of a request or reply in bytes, without the framing of a transport."""

FUNCTIONS = tuple(Function(*row) for row in _core.FUNCTIONS)
OF_CODE = {each.code: each for each in FUNCTIONS}
CODES = tuple(OF_CODE)
MAX_CODE = 0x7F
"""The largest function code; greater ones are exceptions (V1.1b3, 4.1)."""

READ_RECORDS = _core.READ_RECORDS
"""Maximum number of file records that one request reads."""

WRITE_RECORDS = _core.WRITE_RECORDS
"""Maximum number of file records that one request writes."""

LAST_RECORD = _core.LAST_RECORD
"""The greatest number of a record in a file."""

READ_EXCEPTION_STATUS = 7
"""Memories have this function only where the bits that it reads are set."""

GET_COMM_EVENT_LOG = 12
"""Memories have this function only on listeners with an event log."""

FILE_FUNCTIONS = frozenset({20, 21})
"""Memories have these functions only if they have files."""

READ_FIFO_QUEUE = 24
"""Memories have this function only if they have queues."""

OPTIONAL_CODES = {READ_EXCEPTION_STATUS, GET_COMM_EVENT_LOG, *FILE_FUNCTIONS, READ_FIFO_QUEUE}
"""Functions that memories have only with settings of their own."""

WRITING_CODES = tuple(each.code for each in FUNCTIONS if each.writes)

BROADCAST_CODES = tuple(each.code for each in FUNCTIONS if each.writes and not each.most_read)
"""Functions that can be broadcast on a serial line: writes that return no values (V1.02, 2.1)."""

READ_WRITE = OF_CODE[23]
"""The function that writes and reads registers in one step."""

READ_FUNCTIONS: dict[Area, Function] = {area: OF_CODE[code] for area, code in _core.READ_FUNCTIONS}
"""The function that reads an area, in the order of `holdfast.types.AREAS`."""

READ_LIMITS: dict[Area, int] = {
    area: function.most_read for area, function in READ_FUNCTIONS.items()
}
"""Maximum number of bits or registers that one request reads, by area."""

WRITE_LIMITS: dict[Area, int] = {
    area: max(each.most_written for each in FUNCTIONS if each.area == area)
    for area in READ_FUNCTIONS
    if any(each.writes for each in FUNCTIONS if each.area == area)
}
"""Maximum number of bits or registers that one request writes, by writable area."""

READ_REGISTERS = READ_LIMITS["holding_registers"]
READ_BITS = READ_LIMITS["coils"]
WRITE_REGISTERS = WRITE_LIMITS["holding_registers"]
WRITE_BITS = WRITE_LIMITS["coils"]

MAX_ROLE = 255
"""Bytes of the longest role of a certificate that rules can have."""

EXCEPTIONS = _core.EXCEPTIONS
"""The names of exceptions, by code (V1.1b3, 7)."""

_EXCEPTION = {name: code for code, name in EXCEPTIONS.items()}

ILLEGAL_FUNCTION = _EXCEPTION["Illegal Function"]
ILLEGAL_ADDRESS = _EXCEPTION["Illegal Data Address"]
ILLEGAL_VALUE = _EXCEPTION["Illegal Data Value"]
ACKNOWLEDGE = _EXCEPTION["Acknowledge"]
BUSY = _EXCEPTION["Server Device Busy"]
PATH_UNAVAILABLE = _EXCEPTION["Gateway Path Unavailable"]
TARGET_SILENT = _EXCEPTION["Gateway Target Device Failed To Respond"]

GATEWAY_FAILURES = (PATH_UNAVAILABLE, TARGET_SILENT)
"""Exceptions of a gateway that does not reach the device."""

HARMLESS_DIAGNOSTICS = tuple(code for code, _, changes in _core.SUB_FUNCTIONS if not changes)
"""Sub-functions of function 8 that change nothing: echo, diagnostic register, counters."""
