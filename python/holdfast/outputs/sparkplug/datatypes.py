"""Types of Sparkplug, and values of tags as values of metrics."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.values.digits import shortest

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.tags import Tag

INT32, INT64, FLOAT, DOUBLE, BOOLEAN, STRING = 3, 4, 9, 10, 11, 12
FIRST_ARRAY = 22

_INTEGERS = {
    "int16": ("Int16", 2),
    "int32": ("Int32", 3),
    "int64": ("Int64", 4),
    "uint16": ("UInt16", 6),
    "bcd16": ("UInt16", 6),
    "uint32": ("UInt32", 7),
    "bcd32": ("UInt32", 7),
    "uint64": ("UInt64", 8),
}
_OTHERS = {
    "float16": ("Float", 9),
    "float32": ("Float", 9),
    "float64": ("Double", 10),
    "bool": ("Boolean", 11),
    "bit": ("Boolean", 11),
    "string": ("String", 12),
    "bytes": ("Bytes", 17),
}
_BASES = _INTEGERS | _OTHERS

_ARRAYS = {2: 23, 3: 24, 4: 25, 6: 27, 7: 28, 8: 29, 9: 30, 10: 31, 11: 32, 12: 33}
"""The type of an array, by the type of its items."""

_FORMATS = {23: "h", 24: "i", 25: "q", 27: "H", 28: "I", 29: "Q", 30: "f", 31: "d"}

_FIELDS = {
    2: "int_value",
    3: "int_value",
    4: "long_value",
    6: "int_value",
    7: "long_value",
    8: "long_value",
    9: "float_value",
    10: "double_value",
    11: "boolean_value",
    12: "string_value",
    17: "bytes_value",
}
_VALUES = (*dict.fromkeys(_FIELDS.values()),)


class Datatype(NamedTuple):
    """The type of a metric, and how a value gets into it."""

    number: int
    """As in the specification."""
    name: str
    field: str
    """The field of the metric."""
    packed: Callable[[Any], Any]
    """Converts a value to that of the field."""


def datatype_of(tag: Tag) -> tuple[Datatype, bool]:
    """The type of the metrics of a tag, and whether each item of it has a metric of its own.

    An array in Sparkplug has no items without a value, and there are no arrays of bytes.
    """
    name, number = _BASES[tag.of_type.base]
    if tag.is_number and (tag.scale, tag.offset) != (1, 0):
        name, number = "Double", DOUBLE
    is_array = tag.of_type.count is not None
    if is_array and number in _ARRAYS and (not tag.null or number in (FLOAT, DOUBLE)):
        array = _ARRAYS[number]
        return Datatype(array, f"{name}Array", "bytes_value", _packer(array)), False
    return Datatype(number, name, _FIELDS[number], _single(number)), is_array


def _single(number: int) -> Callable[[Any], Any]:
    if number in (2, 3):
        return lambda value: value & 0xFFFFFFFF
    if number == INT64:
        return lambda value: value & 0xFFFFFFFFFFFFFFFF
    if number == DOUBLE:
        return _double
    return lambda value: value


def _packer(array: int) -> Callable[[Any], bytes]:
    if array == 32:
        return _bits
    if array == 33:
        return _texts
    item = _FORMATS[array]
    if array in (30, 31):
        return lambda values: struct.pack(f"<{len(values)}{item}", *map(_double, values))
    return lambda values: struct.pack(f"<{len(values)}{item}", *values)


def _double(value: float | None) -> float:
    """A number as a float; an integer that is too large is infinite, no value is NaN."""
    try:
        return math.nan if value is None else float(value)
    except OverflowError:
        return math.inf if value is not None and value > 0 else -math.inf


def _bits(values: list[bool]) -> bytes:
    """A number of bits, then the bits, the first of a byte being the most significant."""
    data = bytearray(-(-len(values) // 8))
    for place, value in enumerate(values):
        data[place // 8] |= bool(value) << 7 - place % 8
    return struct.pack("<I", len(values)) + data


def _texts(values: list[str]) -> bytes:
    return b"".join(value.replace("\0", "").encode() + b"\0" for value in values)


def value_of(metric: Any, datatype: Datatype) -> Any:
    """The value of a metric in a command. Raises `ValueError`.

    Hosts differ in the field that they use for an integer, so each field is accepted.
    """
    field = next((name for name in _VALUES if metric.HasField(name)), None)
    if field is None or metric.is_null:
        raise ValueError("it has no value")
    found = getattr(metric, field)
    if field == "string_value" and not isinstance(found, str):
        raise ValueError("its text is not UTF-8")
    if datatype.field in ("int_value", "long_value") and field in ("int_value", "long_value"):
        return _signed(found, field, metric.datatype or datatype.number)
    if datatype.number in (FLOAT, DOUBLE) and field == "float_value":
        return float(shortest(found, "float32"))
    if datatype.number in (FLOAT, DOUBLE) and field == "double_value":
        return found
    if datatype.number in (FLOAT, DOUBLE) and field in ("int_value", "long_value"):
        return _signed(found, field, metric.datatype)
    if field != datatype.field:
        raise ValueError(f"found a value in {field}, allowed: {datatype.name}")
    return _unpacked(found, datatype) if datatype.number >= FIRST_ARRAY else found


def _signed(value: int, field: str, number: int) -> int:
    """An integer, whose sign is in the highest bit of its field."""
    if number not in (1, 2, 3, 4):
        return value
    bits = 32 if field == "int_value" else 64
    return value - (1 << bits) if value >> bits - 1 else value


def _unpacked(data: bytes, datatype: Datatype) -> list[Any]:
    if datatype.number == 33:
        return [text.decode() for text in data.split(b"\0")[:-1]]
    if datatype.number == 32:
        if len(data) < 4 or len(data) != 4 + -(-(size := struct.unpack("<I", data[:4])[0]) // 8):
            raise ValueError("an array of another length")
        return [bool(data[4 + place // 8] >> 7 - place % 8 & 1) for place in range(size)]
    item = _FORMATS[datatype.number]
    count, rest = divmod(len(data), struct.calcsize(f"<{item}"))
    if rest:
        raise ValueError("an array of another length")
    return list(struct.unpack(f"<{count}{item}", data))
