"""Encodes Raw Ingest packets from values, which are checked and never converted."""

from __future__ import annotations

import reprlib
from typing import TYPE_CHECKING, Literal, TypeAlias, TypedDict

from holdfast._core import encode_raw_ingest, pack_raw_ingest
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_WORD
from holdfast.types import AREAS, BIT_AREAS
from holdfast.values.integers import as_integer

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.types import Area

Format: TypeAlias = Literal["v1", "crc"]
Crc: TypeAlias = Literal["required", "none"]
Data: TypeAlias = bytes | bytearray | memoryview

MAX_FIELD = MAX_WORD


class Options(TypedDict, total=False):
    """The options of `encode`."""

    data: Data | None
    count: int | None
    unit: int | None
    memory_id: int | None
    format: Format | None
    crc: Crc | None


def encode(
    area: Area,
    address: int,
    values: Iterable[int] | None = None,
    *,
    data: Data | None = None,
    count: int | None = None,
    unit: int | None = None,
    memory_id: int | None = None,
    format: Format | None = None,
    crc: Crc | None = None,
) -> bytes:
    """Encodes one packet: format v1 with `unit`, format crc with `memory_id`.

    `values` are 1 to 65535 bits (0, 1, False, True) or registers (integers 0 to 65535). `data` is
    the alternative: the payload as on the wire, registers high byte first, or bits packed least
    significant bit first with their `count`. Set `crc` to "none" for receivers of format crc that
    expect no CRC after the payload. `format` is optional and must match.

    Raises `ValueError` for a packet that no receiver accepts, `TypeError` for a value of another
    type: values are never converted, truncated or wrapped.
    """
    if area not in AREAS:
        raise ValueError(f"area is {reprlib.repr(area)}, allowed: {', '.join(AREAS)}")
    if (unit is None) == (memory_id is None):
        raise TypeError("a packet requires either a unit (format v1) or a memory_id (format crc)")
    layout: Format = "crc" if unit is None else "v1"
    if format not in (None, layout):
        raise ValueError(f"format is {format!r}, but the packet is of format {layout}")
    if crc not in (None, "required", "none"):
        raise ValueError(f"crc is {crc!r}, allowed: 'required' or 'none'")
    if crc is not None and layout == "v1":
        raise ValueError("crc requires format crc: a packet of format v1 has no CRC")
    address = checked_field("address", address)
    payload, items = _payload(area, values, data, count)
    if address + items > ADDRESSES:
        last = f"the last address is {LAST_ADDRESS}"
        raise ValueError(f"{area}: {items} from address {address}, {last}")
    target = checked_field("memory_id", memory_id) if unit is None else checked_field("unit", unit)
    return encode_raw_ingest(
        payload,
        area=area,
        address=address,
        count=items,
        target=target,
        format=layout,
        crc=crc or "required",
    )


def _payload(
    area: Area, values: Iterable[int] | None, data: Data | None, count: int | None
) -> tuple[bytes, int]:
    """The payload, and its number of values."""
    if (values is None) == (data is None):
        raise TypeError("a packet requires either values or data")
    if count is not None:
        count = checked_field("count", count, least=1)
    if data is not None:
        return _checked(area, data, count)
    if isinstance(values, Data):
        raise TypeError("values are bytes; pass them as data")
    assert values is not None
    payload, items = pack_raw_ingest(area, values)
    if not 1 <= items <= MAX_FIELD:
        raise ValueError(f"found {items} values, allowed: 1 to {MAX_FIELD}")
    if count not in (None, items):
        raise ValueError(f"count is {count}, but found {items} values")
    return payload, items


def _checked(area: Area, data: Data, count: int | None) -> tuple[bytes, int]:
    """Checks a payload. Returns it as bytes, with its number of values."""
    if not isinstance(data, Data):
        raise TypeError(f"data is {reprlib.repr(data)}, not bytes")
    payload = bytes(data)
    if area in BIT_AREAS:
        if count is None:
            raise TypeError("data of bits requires a count")
        if len(payload) != (count + 7) // 8:
            raise ValueError(
                f"{count} {area} require {(count + 7) // 8} bytes, data has {len(payload)}"
            )
        return payload, count
    if len(payload) % 2 or not 1 <= len(payload) // 2 <= MAX_FIELD:
        raise ValueError(
            f"data has {len(payload)} bytes, allowed: 2 for each of 1 to {MAX_FIELD} registers"
        )
    if count not in (None, len(payload) // 2):
        raise ValueError(f"count is {count}, but data has {len(payload) // 2} registers")
    return payload, len(payload) // 2


def checked_field(name: str, value: object, least: int = 0) -> int:
    """Returns an integer from `least` to 65535. Raises `TypeError` and `ValueError`."""
    number = as_integer(value)
    if number is None:
        raise TypeError(
            f"{name} is {reprlib.repr(value)}, allowed: integers {least} to {MAX_FIELD}"
        )
    if not least <= number <= MAX_FIELD:
        raise ValueError(f"{name} is {value}, allowed: {least} to {MAX_FIELD}")
    return number
