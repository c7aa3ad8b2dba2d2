"""Types of Sparkplug, and values of tags as values of metrics."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.protocol import READ_LIMITS
from holdfast.tags.text import plain
from holdfast.values.digits import shortest

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.tags import Tag

INT32, INT64, FLOAT, DOUBLE, BOOLEAN, STRING = 3, 4, 9, 10, 11, 12
FLOAT_ARRAY, DOUBLE_ARRAY, BOOLEAN_ARRAY, STRING_ARRAY = 30, 31, 32, 33

MAX_ITEMS = max(READ_LIMITS.values())
"""The most numbers in an array: those of the longest tag."""


class _Base(NamedTuple):
    """A type of metrics, with the types of tags that have it."""

    name: str
    field: str
    """The field of a metric."""
    tags: tuple[str, ...]
    array: int | None = None
    """The type of an array of these, if there is one."""
    item: str = ""
    """The format of an item of such an array."""


_BASES = {
    2: _Base("Int16", "int_value", ("int16",), 23, "h"),
    INT32: _Base("Int32", "int_value", ("int32",), 24, "i"),
    INT64: _Base("Int64", "long_value", ("int64",), 25, "q"),
    6: _Base("UInt16", "int_value", ("uint16", "bcd16"), 27, "H"),
    7: _Base("UInt32", "long_value", ("uint32", "bcd32"), 28, "I"),
    8: _Base("UInt64", "long_value", ("uint64",), 29, "Q"),
    FLOAT: _Base("Float", "float_value", ("float16", "float32"), FLOAT_ARRAY, "f"),
    DOUBLE: _Base("Double", "double_value", ("float64",), DOUBLE_ARRAY, "d"),
    BOOLEAN: _Base("Boolean", "boolean_value", ("bool", "bit"), BOOLEAN_ARRAY),
    STRING: _Base("String", "string_value", ("string",), STRING_ARRAY),
    17: _Base("Bytes", "bytes_value", ("bytes",)),
}
"""The types by number, as in the specification."""

_OF_TAG = {tag: number for number, base in _BASES.items() for tag in base.tags}
_FORMATS = {base.array: base.item for base in _BASES.values() if base.item}
_FIELDS = tuple(dict.fromkeys(base.field for base in _BASES.values()))
_INTEGER_FIELDS = {"int_value": 32, "long_value": 64}
"""The fields of integers, with their bits."""

_SIGNED = {1: 8, 2: 16, INT32: 32, INT64: 64}
_UNSIGNED = {5: 8, 6: 16, 7: 32, 8: 64}
"""The types of integers by number, with their bits. A tag has none of 8 bits, a command may."""


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
    number = _OF_TAG[tag.of_type.base]
    if tag.is_number and (tag.scale, tag.offset) != (1, 0):
        number = DOUBLE
    base, by_item = _BASES[number], tag.of_type.count is not None
    made = Datatype(number, base.name, base.field, _single(number))
    if by_item and base.array is not None and (not tag.null or number in (FLOAT, DOUBLE)):
        made = Datatype(base.array, f"{base.name}Array", "bytes_value", _packer(base.array))
        by_item = False
    if number == DOUBLE and tag.of_type.base == "float32":
        packed = made.packed
        made = made._replace(packed=lambda value: packed(_with_digits(tag, value)))
    return made, by_item


def _with_digits(tag: Tag, value: Any) -> Any:
    """A scaled `float32` as it is shown: a Double has digits that its registers do not have."""
    if isinstance(value, list):
        return [_with_digits(tag, item) for item in value]
    return value if value is None or math.isinf(value) else plain(tag, value)


def _single(number: int) -> Callable[[Any], Any]:
    if number in _SIGNED:  # The fields of integers have no sign.
        mask = (1 << _INTEGER_FIELDS[_BASES[number].field]) - 1
        return lambda value: value & mask
    return _double if number == DOUBLE else lambda value: value


def _packer(array: int) -> Callable[[Any], bytes]:
    if array == BOOLEAN_ARRAY:
        return _bits
    if array == STRING_ARRAY:
        return _texts
    item = _FORMATS[array]
    if array in (FLOAT_ARRAY, DOUBLE_ARRAY):
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
    """Texts that end with NUL, as the specification has it: none can have one inside."""
    return b"".join(value.replace("\0", "").encode() + b"\0" for value in values)


def value_of(metric: Any, datatype: Datatype) -> Any:
    """The value of a metric in a command. Raises `ValueError`.

    Hosts differ in the type that they use for a number, and in the field for an integer: each is
    accepted. A command without a type has that of the birth.
    """
    field = next((name for name in _FIELDS if metric.HasField(name)), None)
    if field is None or metric.is_null:
        raise ValueError("it has no value")
    found = getattr(metric, field)
    if field == "string_value" and not isinstance(found, str):
        raise ValueError("its text is not UTF-8")
    number = metric.datatype or datatype.number
    is_float = datatype.number in (FLOAT, DOUBLE)
    if field in _INTEGER_FIELDS and (is_float or datatype.field in _INTEGER_FIELDS):
        return _integer(found, field, number)
    if is_float and field == "float_value":
        return float(shortest(found, "float32"))
    if is_float and field == "double_value":
        return found
    if field != datatype.field:
        raise ValueError(f"found a value in {field}, allowed: {datatype.name}")
    if field == "bytes_value":
        if number != datatype.number:
            raise ValueError(f"found the type {number}, allowed: {datatype.name}")
        return _unpacked(found, number)
    return found


def _integer(value: int, field: str, number: int) -> int:
    """An integer of a type. Raises `ValueError`.

    Hosts send a negative one in the bits of its type, as Tahu's client for Python does, or in
    those of the field.
    """
    width = _INTEGER_FIELDS[field]
    if number in _UNSIGNED:
        if value >> _UNSIGNED[number]:
            raise ValueError(f"{value} in {field} is no UInt{_UNSIGNED[number]}")
        return value
    bits = _SIGNED.get(number)
    if bits is None:
        raise ValueError(f"found the type {number} of {field}, allowed: a type of integers")
    # In the field that is too narrow for its type, a value with the highest bit may be either.
    if value < 1 << min(bits, width) - 1:
        return value
    for size in {bits, width}:
        if bits <= size and -(1 << bits - 1) <= value - (1 << size) < 0:
            return value - (1 << size)
    raise ValueError(f"{value} in {field} is no Int{bits}")


def _unpacked(data: bytes, number: int) -> Any:
    if number == STRING_ARRAY:
        return [text.decode() for text in data.split(b"\0")[:-1]]
    if number == BOOLEAN_ARRAY:
        if len(data) < 4 or len(data) != 4 + -(-(size := struct.unpack("<I", data[:4])[0]) // 8):
            raise ValueError("an array of another length")
        return [bool(data[4 + place // 8] >> 7 - place % 8 & 1) for place in range(size)]
    item = _FORMATS.get(number)
    if item is None:
        return data
    count, rest = divmod(len(data), struct.calcsize(f"<{item}"))
    if rest or count > MAX_ITEMS:
        raise ValueError("an array of another length")
    values = struct.unpack(f"<{count}{item}", data)
    if number == FLOAT_ARRAY:
        return [float(shortest(value, "float32")) for value in values]
    return list(values)
