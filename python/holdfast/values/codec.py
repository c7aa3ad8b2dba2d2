"""One field: a type in an order, compiled once, then used for any registers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from holdfast.types import BIT_AREAS
from holdfast.values.bcd import Bcd
from holdfast.values.bits import Bit, Bool
from holdfast.values.errors import (
    DoesNotFit,
    UnknownEncoding,
    WrongArea,
    WrongLength,
    counted,
    shown,
)
from holdfast.values.numeric import INTEGERS, Float, Integer
from holdfast.values.orders import FOUR, order_of, swap_registers
from holdfast.values.registers import RegisterBlock
from holdfast.values.text import Bytes, Text
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.types import Area
    from holdfast.values.kinds import Kind
    from holdfast.values.orders import Order
    from holdfast.values.registers import Registers
    from holdfast.values.types import Type


def decode(
    registers: Registers, type: str, order: str = "ABCD", *, encoding: str | None = None
) -> Any:
    """The value that registers hold: a bool, int, float, str or bytes, a list of an array type.

    `registers` are exactly those of the field, as integers 0 to 65535, as big-endian bytes, or as a
    buffer of unsigned 16-bit integers; for `bool` bits will do. `encoding` is that of strings,
    ASCII if not given.

    Raises `ConversionError`; `TypeError` for registers that are no such sequence.
    """
    codec = codec_of(type, order, encoding)
    return codec.unpack(codec.to_bytes(registers))


def encode(value: Any, type: str, order: str = "ABCD", *, encoding: str | None = None) -> list[int]:
    """The registers, 0 to 65535, that hold a value, or a sequence of values for an array type.

    A single `bit:N` becomes a mask for its register: only that bit is set for true, which is to be
    ORed, and all but that bit for false, which is to be ANDed.

    Raises `ConversionError`.
    """
    return codec_of(type, order, encoding).encode(value)


def register_count(type: str) -> int:
    """How many registers a field of this type takes; bits for `bool`. Raises `UnknownType`."""
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
        """The bytes of registers in any form, those of each register swapped if `swapped`."""
        self._to_registers = block.unpack
        self.unpack = kind.unpack_one if type.count is None else kind.unpack_many
        """The value of those bytes."""
        single = type.count is None
        self.item = kind.item if single else f"{2 * type.registers}s"
        """The field as an item of `struct`, in the byte order `kind.mark`."""
        self.finish = kind.finish if single else kind.unpack_many
        """What makes that item the value, if it isn't already."""

    def encode(self, value: Any) -> list[int]:
        """The registers of a value."""
        if self.type.count is None:
            return self._to_registers(self.kind.pack_one(value))
        return self._to_registers(self._pack_array(value))

    def pack(self, value: Any) -> bytes:
        """The bytes of a value as they are on the wire."""
        data = self.kind.pack_one(value) if self.type.count is None else self._pack_array(value)
        return swap_registers(data) if self.swapped else data

    def _pack_array(self, values: Any) -> bytes:
        if hasattr(values, "tolist"):
            values = values.tolist()
        if not isinstance(values, Sequence) or isinstance(values, str | bytes | bytearray):
            raise DoesNotFit(f"{shown(values)} is no sequence, which {self.type.name} holds")
        if len(values) != self.type.count:
            takes = counted(self.type.count or 0, "value")
            raise WrongLength(f"{self.type.name} takes {takes}, found {len(values)}")
        return self.kind.pack_many(values)


@lru_cache(1024)
def codec_of(name: str, order: str, encoding: str | None) -> Codec:
    """The codec of a type. Raises `UnknownType`, `UnknownOrder` and `UnknownEncoding`."""
    type = parsed(name)
    bytes_order = order_of(order, type.element, type.width)
    if encoding is not None and type.base != "string":
        raise UnknownEncoding(f"encoding {shown(encoding)} is for strings, {type.name} is none")
    if type.base == "bool":
        bytes_order = FOUR["ABCD"]
    return Codec(
        type, bytes_order, _kind(type, bytes_order, "ascii" if encoding is None else encoding)
    )


def codec_for(area: Area, name: str, order: str = "ABCD", encoding: str | None = None) -> Codec:
    """The codec of a type in an area: whatever a typed value is asked for with, checked together.

    Raises as `codec_of`, and `WrongArea`.
    """
    codec = codec_of(name, order, encoding)
    if area in BIT_AREAS and codec.type.base != "bool":
        raise WrongArea(f"type is {name!r}, {area} hold only bool")
    return codec


def _kind(type: Type, order: Order, encoding: str) -> Kind:
    if type.base == "string":
        return Text(type, order, encoding)
    return KINDS.get(type.base, Float)(type, order)
