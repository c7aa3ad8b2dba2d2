"""What requests of the first generation mean, where their program has rules of its own.

Its callers must get the values that they got from tentacle-modbus, or a warning. Does no I/O.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.protocol import WRITE_LIMITS
from holdfast.scanner.errors import Refused

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.scanner.messages.types import TagRequest, UnsubscribeRequest
    from holdfast.types import Area

PAUSES_S = (2.0, 60.0)
"""The first and the longest pause before a device is connected to again. They double in between."""

FLOAT64_ORDERS = {"CDAB": "CDABGHEF"}
"""The byte orders of a float64 that mean another one there: it swaps the words of each half."""

SWAPPED = ("BADC", "DCBA")
"""The orders that swap the bytes of a single register."""


def order(datatype: str, asked: str) -> str:
    """Returns the byte order of a tag: in eight letters, where the four of the request mislead."""
    return FLOAT64_ORDERS.get(asked, asked) if datatype == "float64" else asked


def warnings(request: TagRequest, area: Area, asked: str) -> Iterator[str]:
    """Yields what the caller must know of a tag with the byte order `asked`."""
    datatype = request.datatype
    if (used := order(datatype, asked)) != asked:
        yield (
            f"{asked} of a float64 is read and written as {used}, as tentacle-modbus does; "
            f"write {used}, or the order that you mean, with eight letters"
        )
    is_written = area in WRITE_LIMITS and request.writable is not False
    if datatype in ("int16", "uint16") and asked in SWAPPED and is_written:
        yield (
            f"{asked} swaps the bytes of the {datatype} in reads and in writes; tentacle-modbus "
            "swaps them in reads only: a program that swaps the bytes of its commands itself must "
            "not do so any more"
        )


def check_unsubscribe(request: UnsubscribeRequest) -> None:
    """Raises `Refused` for a request that may have lost its tags, and would end everything."""
    if request.tag_ids is None:
        raise Refused('tagIds is missing, allowed: a list of tag ids, or "all"')
