"""Codecs: a type in a byte order, compiled once, then used for any registers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, overload

from holdfast.runtime.text import counted
from holdfast.types import BIT_AREAS
from holdfast.values.bits import Bit, Bool
from holdfast.values.errors import DoesNotFit, UnknownEncoding, WrongArea, WrongLength, shown
from holdfast.values.numeric import INTEGERS, Bcd, Float, Integer
from holdfast.values.orders import DEFAULT_ORDER, FOUR, order_of, swap_registers
from holdfast.values.registers import RegisterBlock
from holdfast.values.text import Bytes, Text
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.types import Area, BoolType, ByteOrder, FloatType, IntegerType, ValueType
    from holdfast.values.kinds import Kind
    from holdfast.values.orders import Order
    from holdfast.values.registers import Registers
    from holdfast.values.types import Type


@overload
def decode(
    registers: Registers, type: BoolType, order: ByteOrder = "ABCD", *, encoding: str | None = None
) -> bool: ...
@overload
def decode(
    registers: Registers,
    type: IntegerType,
    order: ByteOrder = "ABCD",
    *,
    encoding: str | None = None,
) -> int: ...
@overload
def decode(
    registers: Registers, type: FloatType, order: ByteOrder = "ABCD", *, encoding: str | None = None
) -> float: ...
@overload
def decode(
    registers: Registers, type: ValueType, order: ByteOrder = "ABCD", *, encoding: str | None = None
) -> Any: ...
def decode(
    registers: Registers, type: ValueType, order: ByteOrder = "ABCD", *, encoding: str | None = None
) -> Any:
    """Converts registers to a bool, int, float, str or bytes; to a list for an array type.

    `registers` are exactly the registers of the field: integers 0 to 65535, big-endian bytes, or a
    buffer of unsigned 16-bit integers; for `bool`, also bits. `encoding` is the encoding of
    strings. Default: ASCII.

    Raises `ConversionError`, or `TypeError` if `registers` is not such a sequence.
    """
    codec = codec_of(type, order, encoding)
    return codec.unpack(codec.to_bytes(registers))


def encode(
    value: Any, type: ValueType, order: ByteOrder = "ABCD", *, encoding: str | None = None
) -> list[int]:
    """Converts a value, or a sequence of values for an array type, to registers, 0 to 65535.

    A single `bit:N` becomes a mask for its register: for true, only that bit is set, for OR; for
    false, all other bits are set, for AND.

    Raises `ConversionError`.
    """
    return codec_of(type, order, encoding).encode(value)


def register_count(type: ValueType) -> int:
    """Registers per field of this type; for `bool`, bits. Raises `UnknownType`."""
    return parsed(type).registers


KINDS: dict[str, Callable[[Type, Order], Kind]] = {
    "bool": Bool,
    "bit": Bit,
    "bytes": Bytes,
    "bcd16": Bcd,
    "bcd32": Bcd,
    **dict.fromkeys(INTEGERS, Integer),
}


class Codec:
    """Converts the values of one type in one order."""

    def __init__(self, type: Type, order: Order, kind: Kind) -> None:
        self.type = type
        self.kind = kind
        self.swapped = order.swapped
        block = RegisterBlock(
            type.registers, type.name, swapped=order.swapped, bits=type.base == "bool"
        )
        self.to_bytes = block.pack
        """Converts registers in any form to bytes; swaps the bytes of each if `swapped`."""
        self._to_registers = block.unpack
        single = type.count is None
        self.unpack = kind.unpack_one if single else kind.unpack_many
        """Converts those bytes to the value."""
        self.struct_format = kind.struct_format if single else f"{2 * type.registers}s"
        """The format of the field for `struct`, in the byte order `kind.mark`."""
        self.finish = kind.finish if single else kind.unpack_many
        """Converts the result of `struct` to the value; `None` if they are equal."""

    def encode(self, value: Any) -> list[int]:
        """The registers of a value."""
        return self._to_registers(self._packed(value))

    def pack(self, value: Any) -> bytes:
        """The bytes of a value as on the wire."""
        data = self._packed(value)
        return swap_registers(data) if self.swapped else data

    def _packed(self, values: Any) -> bytes:
        count = self.type.count
        if count is None:
            return self.kind.pack_one(values)
        if hasattr(values, "tolist"):
            values = values.tolist()
        if not isinstance(values, Sequence) or isinstance(values, str | bytes | bytearray):
            raise DoesNotFit(f"{shown(values)} is not a sequence, which {self.type.name} requires")
        if len(values) != count:
            takes = counted(count, "value")
            raise WrongLength(f"{self.type.name} takes {takes}, found {len(values)}")
        return self.kind.pack_many(values)


@lru_cache(1024)
def codec_of(name: str, order: str, encoding: str | None) -> Codec:
    """The codec of a type. Raises `UnknownType`, `UnknownOrder` and `UnknownEncoding`."""
    type = parsed(name)
    bytes_order = order_of(order, type.element, type.width)
    if encoding is not None and type.base != "string":
        raise UnknownEncoding(f"encoding {shown(encoding)} is for strings, not for {type.name}")
    if type.base == "bool":
        bytes_order = FOUR["ABCD"]
    return Codec(
        type, bytes_order, _kind(type, bytes_order, "ascii" if encoding is None else encoding)
    )


def codec_for(
    area: Area, name: str, order: str = DEFAULT_ORDER, encoding: str | None = None
) -> Codec:
    """The codec of a type in an area, with all parameters of a typed value checked together.

    Raises the errors of `codec_of`, and `WrongArea`.
    """
    codec = codec_of(name, order, encoding)
    if area in BIT_AREAS and codec.type.base != "bool":
        raise WrongArea(f"type is {name!r}, allowed in {area}: bool")
    return codec


def _kind(type: Type, order: Order, encoding: str) -> Kind:
    if type.base == "string":
        return Text(type, order, encoding)
    return KINDS.get(type.base, Float)(type, order)
