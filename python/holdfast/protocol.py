"""What the standard fixes: areas and addresses, functions and their limits, exceptions.

All of it comes from the native core; what is derived of it is derived here. Nothing else in Python
writes one of these numbers down.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from holdfast import _core

if TYPE_CHECKING:
    from holdfast.types import Area, Transport

ADDRESSES = _core.ADDRESSES
"""How many addresses an area can have."""

LAST_ADDRESS = ADDRESSES - 1
MAX_WORD = 0xFFFF
"""The largest value of a register, and of every other field of 16 bits."""

MAX_UNIT = 0xFF
MAX_SERIAL_UNIT = 247
"""The largest unit id, and that of a device on a serial line (V1.02, 2.2)."""

PORT = 502
TLS_PORT = 802
"""The ports of Modbus over TCP and UDP, and over TLS."""


def usual_port(transport: Transport) -> int:
    """The port that is meant where none is named."""
    return TLS_PORT if transport == "tls" else PORT


class Function(NamedTuple):
    """A function that servers and clients here know (V1.1b3, 6)."""

    code: int
    name: str
    writes: bool
    """Whether it changes bits or registers."""
    area: Area | None
    """What it reads or writes; `None` for those that are about the device."""
    most_read: int
    """The most bits or registers that it reads, 0 if it reads none."""
    most_written: int


MAX_PDU = _core.MAX_PDU
"""Bytes of the longest request or reply, without what a transport puts around it."""

FUNCTIONS = tuple(Function(*row) for row in _core.FUNCTIONS)
OF_CODE = {each.code: each for each in FUNCTIONS}
CODES = tuple(OF_CODE)
WRITING_CODES = tuple(each.code for each in FUNCTIONS if each.writes)

BROADCAST_CODES = tuple(each.code for each in FUNCTIONS if each.writes and not each.most_read)
"""Those that may be sent to all units of a serial line: writes without an answer to wait for
(V1.02, 2.1)."""

READ_WRITE = OF_CODE[23]
"""The function that writes registers and reads some, as one step."""

READ_FUNCTIONS: dict[Area, Function] = {
    each.area: each for each in FUNCTIONS if each.area is not None and not each.writes
}
"""The function that reads an area, in the order of `holdfast.types.AREAS`."""

READ_LIMITS: dict[Area, int] = {
    area: function.most_read for area, function in READ_FUNCTIONS.items()
}
"""The most bits or registers that one request reads."""

WRITE_LIMITS: dict[Area, int] = {
    area: max(each.most_written for each in FUNCTIONS if each.area == area)
    for area in READ_FUNCTIONS
    if any(each.writes for each in FUNCTIONS if each.area == area)
}
"""The most that one request writes, of the areas that can be written."""

READ_REGISTERS = READ_LIMITS["holding_registers"]
READ_BITS = READ_LIMITS["coils"]
WRITE_REGISTERS = WRITE_LIMITS["holding_registers"]
WRITE_BITS = WRITE_LIMITS["coils"]

EXCEPTIONS = _core.EXCEPTIONS
"""The names of exceptions by their codes (V1.1b3, 7)."""

_EXCEPTION = {name: code for code, name in EXCEPTIONS.items()}

ILLEGAL_FUNCTION = _EXCEPTION["Illegal Function"]
ILLEGAL_ADDRESS = _EXCEPTION["Illegal Data Address"]
ILLEGAL_VALUE = _EXCEPTION["Illegal Data Value"]
BUSY = _EXCEPTION["Server Device Busy"]
PATH_UNAVAILABLE = _EXCEPTION["Gateway Path Unavailable"]
TARGET_SILENT = _EXCEPTION["Gateway Target Device Failed To Respond"]

HARMLESS_DIAGNOSTICS = tuple(code for code, _, changes in _core.SUB_FUNCTIONS if not changes)
"""Sub-functions of function 8 that change nothing: the echo, the diagnostic register, counters."""
