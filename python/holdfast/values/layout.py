"""Layouts: the named fields of a block of registers, compiled once, converted in one call.

One `struct` call reads all fields of one order and skips the bytes between them; overlapping fields
take another call. Bits, strings, BCD and arrays are then finished field by field.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.values.bits import Bit, merge
from holdfast.values.codec import Codec, codec_of
from holdfast.values.errors import ConversionError, DoesNotFit, InvalidLayout, at, shown
from holdfast.values.integers import as_integer
from holdfast.values.orders import DEFAULT_ORDER, swap_registers
from holdfast.values.registers import RegisterBlock
from holdfast.values.types import MAX_REGISTERS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.values.registers import Registers


@dataclass(frozen=True, slots=True)
class Field:
    """A named value in a block, at `offset` registers. `encoding` is for strings."""

    name: str
    type: str
    offset: int
    order: str = DEFAULT_ORDER
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
        self._values = _Reading(self.names, self._codecs, offsets, self.size).values
        self._overlap = _overlap(self.fields, self._codecs)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Layout, size=self.size), (self.fields,)

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

        Raises `InvalidLayout` if fields overlap, `DoesNotFit` if names are missing or unknown,
        `TypeError` for what is not a mapping, and the errors of `encode`, with the name of the
        field in the message and in `field`.
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
        if not isinstance(values, Mapping):
            found = f"values are {shown(values)}"
            raise TypeError(f"{found}, allowed: a mapping with a value for each field")
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
    for (_, end, holder), (start, _, name) in pairwise(extents):
        if start < end:
            return holder, name
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


class _Reading:
    """Reads all fields of a block of `size` registers, each at its offset in registers."""

    def __init__(
        self, names: Sequence[str], codecs: Sequence[Codec], offsets: Sequence[int], size: int
    ) -> None:
        self._names = names
        passes: list[_Pass] = []
        taken: dict[int, tuple[_Pass, int]] = {}
        for index in sorted(range(len(names)), key=offsets.__getitem__):
            taken[index] = _placed(passes, codecs[index], 2 * offsets[index])
        sources = _sources(passes, [taken[index] for index in range(len(names))])
        self._pick = None if sources == list(range(len(sources))) else itemgetter(*sources)
        self._calls = [(one.swapped, one.compiled(2 * size)) for one in passes]
        self._finishing = [
            (index, codec.finish) for index, codec in enumerate(codecs) if codec.finish is not None
        ]

    def values(self, data: bytes) -> Sequence[Any]:
        """The values in the order of the names. Raises `ConversionError` with the field's name."""
        found: tuple[Any, ...] = ()
        swapped = b""
        for is_swapped, unpack in self._calls:
            if is_swapped and not swapped:
                swapped = swap_registers(data)
            found += unpack(swapped if is_swapped else data)
        if self._pick is not None:
            found = self._pick(found)
        return self._finished(list(found)) if self._finishing else found

    def _finished(self, values: list[Any]) -> list[Any]:
        index = 0
        try:
            for index, finish in self._finishing:
                values[index] = finish(values[index])
        except ConversionError as error:
            raise at(self._names[index], error, self._names[index]) from None
        return values


class _Pass:
    """One `struct` call over the block, for fields of one order that do not overlap."""

    def __init__(self, codec: Codec) -> None:
        self.swapped = codec.swapped
        self._mark = self._form = codec.kind.mark
        self._places: dict[tuple[int, str], int] = {}
        self._end = 0

    @property
    def items(self) -> int:
        """How many items the call returns."""
        return len(self._places)

    def place(self, codec: Codec, start: int) -> int | None:
        """The index of a field at byte `start` in the result, `None` if this call can't read it."""
        if codec.swapped is not self.swapped or codec.kind.mark != self._mark:
            return None
        key = start, codec.struct_format
        if start >= self._end:
            self._form += f"{start - self._end}x{codec.struct_format}"
            self._end = start + 2 * codec.type.registers
            self._places[key] = len(self._places)
        return self._places.get(key)

    def compiled(self, size: int) -> Callable[[bytes], tuple[Any, ...]]:
        """The compiled call, for a block of `size` bytes."""
        return struct.Struct(f"{self._form}{size - self._end}x").unpack


def _placed(passes: list[_Pass], codec: Codec, start: int) -> tuple[_Pass, int]:
    """The first pass that can read a field, and the index of the field in that pass."""
    for one in passes:
        place = one.place(codec, start)
        if place is not None:
            return one, place
    passes.append(_Pass(codec))
    return _placed(passes, codec, start)


def _sources(passes: list[_Pass], places: list[tuple[_Pass, int]]) -> list[int]:
    """The index of each field among the items of all passes."""
    firsts, first = {}, 0
    for one in passes:
        firsts[one] = first
        first += one.items
    return [firsts[one] + place for one, place in places]
