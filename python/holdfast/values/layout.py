"""Layouts: the named fields of a block of registers, compiled once, converted in one call."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.integers import as_integer
from holdfast.values.bits import Bit, merge
from holdfast.values.codec import Codec, codec_of
from holdfast.values.errors import ConversionError, DoesNotFit, InvalidLayout, at, shown
from holdfast.values.reading import Reading
from holdfast.values.registers import RegisterBlock
from holdfast.values.types import MAX_REGISTERS

if TYPE_CHECKING:
    from holdfast.values.registers import Registers


@dataclass(frozen=True, slots=True)
class Field:
    """A named value in a block, at `offset` registers. `encoding` is for strings."""

    name: str
    type: str
    offset: int
    order: str = "ABCD"
    encoding: str | None = None


Fields: TypeAlias = Iterable[Field | tuple[Any, ...]]


class Layout:
    """The fields of a block of registers. Fields may overlap and leave gaps.

    Each field is a `Field`, or a tuple of its arguments. The block ends with its last field, or has
    `size` registers. If all fields are `bool`, it can be a block of bits.

    Raises `InvalidLayout`, and the errors of `decode` for an unknown type, order or encoding.
    """

    def __init__(self, fields: Fields, *, size: int | None = None) -> None:
        self.fields = tuple(_field(entry) for entry in fields)
        self.names = tuple(entry.name for entry in self.fields)
        """The names of the fields, in the order of `fields`."""
        if len(set(self.names)) < len(self.names):
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise InvalidLayout(f"two fields have the name {shown(twice)}")
        self._codecs = [_codec(entry) for entry in self.fields]
        self.size = _size(self.fields, self._codecs, size)
        """How many registers the block has."""
        bits = all(codec.type.base == "bool" for codec in self._codecs)
        self._block = RegisterBlock(self.size, "the layout", bits=bits)
        offsets = [entry.offset for entry in self.fields]
        self._values = Reading(self.names, self._codecs, offsets, self.size).values
        self._overlap = _overlap(self.fields, self._codecs)

    def decode(self, registers: Registers) -> dict[str, Any]:
        """The values of all fields by name, in the order of `names`.

        `registers` are exactly the registers of the block, in any form that `decode` accepts.
        Raises `ConversionError`, with the name of the field in its message and in `field`.
        """
        return dict(zip(self.names, self._values(self._block.pack(registers)), strict=True))

    def decode_tuple(self, registers: Registers) -> tuple[Any, ...]:
        """The values of all fields in the order of `names`. Raises the errors of `decode`."""
        return tuple(self._values(self._block.pack(registers)))

    def encode(self, values: Mapping[str, Any], base: Registers | None = None) -> list[int]:
        """Converts the values of all fields to the registers of the block.

        Bits outside all fields are copied from `base`, a block of the same size. Default: 0.

        Raises `InvalidLayout` if fields overlap, `DoesNotFit` if names are missing or unknown, and
        the errors of `encode`, with the name of the field in the message and in `field`.
        """
        if self._overlap is not None:
            first, second = self._overlap
            raise InvalidLayout(f"{first} and {second} overlap, so they can't be encoded")
        self._check_names(values)
        block = bytearray(2 * self.size if base is None else self._block.pack(base))
        for entry, codec in zip(self.fields, self._codecs, strict=True):
            try:
                data = codec.pack(values[entry.name])
            except ConversionError as error:
                raise at(entry.name, error, entry.name) from None
            start = 2 * entry.offset
            if isinstance(codec.kind, Bit):
                merge(block, start, data)
            else:
                block[start : start + len(data)] = data
        return self._block.unpack(block)

    def _check_names(self, values: Mapping[str, Any]) -> None:
        if values.keys() == set(self.names):
            return
        for name in self.names:
            if name not in values:
                raise DoesNotFit(f"the value of {name} is missing")
        unknown = next(name for name in values if name not in self.names)
        raise DoesNotFit(f"the layout has no field {shown(unknown)}")


def _field(entry: Field | tuple[Any, ...]) -> Field:
    made = entry
    if isinstance(entry, tuple) and 3 <= len(entry) <= 5:
        made = Field(*entry)
    if not isinstance(made, Field):
        allowed = "a Field, or a tuple of name, type, offset, order and encoding"
        raise InvalidLayout(f"a field is {shown(entry)}, allowed: {allowed}")
    if not isinstance(made.name, str) or not made.name:
        raise InvalidLayout(f"the name of a field is {shown(made.name)}, allowed: non-empty text")
    offset = as_integer(made.offset)
    if offset is None or not 0 <= offset < MAX_REGISTERS:
        allowed = f"allowed: 0 to {MAX_REGISTERS - 1}"
        raise at(made.name, InvalidLayout(f"offset {shown(made.offset)}, {allowed}"), made.name)
    return made if type(made.offset) is int else replace(made, offset=offset)


def _codec(entry: Field) -> Codec:
    try:
        return codec_of(entry.type, entry.order, entry.encoding)
    except ConversionError as error:
        raise at(entry.name, error, entry.name) from None


def _size(fields: tuple[Field, ...], codecs: list[Codec], size: int | None) -> int:
    if not fields:
        raise InvalidLayout("a layout requires at least one field")
    ends = [
        entry.offset + codec.type.registers for entry, codec in zip(fields, codecs, strict=True)
    ]
    last = max(ends)
    if last > MAX_REGISTERS:
        name = fields[ends.index(last)].name
        found = f"ends after {last} registers, allowed: up to {MAX_REGISTERS}"
        raise at(name, InvalidLayout(found), name)
    if size is None:
        return last
    number = as_integer(size)
    if number is None or not last <= number <= MAX_REGISTERS:
        raise InvalidLayout(f"size {shown(size)}, allowed: {last} to {MAX_REGISTERS}")
    return number


def _overlap(fields: tuple[Field, ...], codecs: list[Codec]) -> tuple[str, str] | None:
    """The names of two fields that share a bit, or `None`."""
    extents = sorted(
        (start, end, entry.name)
        for entry, codec in zip(fields, codecs, strict=True)
        for start, end in _extents(entry.offset, codec)
    )
    furthest, holder = 0, ""
    for start, end, name in extents:
        if start < furthest:
            return holder, name
        furthest, holder = end, name
    return None


def _extents(offset: int, codec: Codec) -> Iterator[tuple[int, int]]:
    """The bits of a field in a block, as starts and ends."""
    registers = codec.type.registers
    if not isinstance(codec.kind, Bit):
        yield 16 * offset, 16 * (offset + registers)
        return
    bit = codec.kind.bit ^ 8 if codec.swapped != codec.kind.order.reversed else codec.kind.bit
    for register in range(offset, offset + registers):
        yield 16 * register + bit, 16 * register + bit + 1
