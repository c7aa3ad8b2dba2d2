"""Reads the fields of a layout from the bytes of its block.

One `struct` call reads all fields of one order and skips the bytes between them; overlapping fields
take another call. Bits, strings, BCD and arrays are then finished field by field.
"""

from __future__ import annotations

import struct
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from holdfast.values.errors import ConversionError, at
from holdfast.values.orders import swap_registers

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.values.codec import Codec


class Reading:
    """Reads all fields of a block of `size` registers, each at its offset in registers."""

    def __init__(
        self, names: Sequence[str], codecs: Sequence[Codec], offsets: Sequence[int], size: int
    ) -> None:
        self._names = names
        passes: list[_Pass] = []
        taken: dict[int, tuple[_Pass, int]] = {}
        for index in sorted(range(len(names)), key=offsets.__getitem__):
            taken[index] = _taken(passes, codecs[index], 2 * offsets[index])
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
        key = start, codec.item
        if key not in self._places and start >= self._end:
            self._form += f"{start - self._end}x{codec.item}"
            self._end = start + 2 * codec.type.registers
            self._places[key] = len(self._places)
        return self._places.get(key)

    def compiled(self, size: int) -> Callable[[bytes], tuple[Any, ...]]:
        """The compiled call, for a block of `size` bytes."""
        return struct.Struct(f"{self._form}{size - self._end}x").unpack


def _taken(passes: list[_Pass], codec: Codec, start: int) -> tuple[_Pass, int]:
    """The first pass that can read a field, and the index of the field in that pass."""
    for one in passes:
        place = one.place(codec, start)
        if place is not None:
            return one, place
    passes.append(_Pass(codec))
    return _taken(passes[-1:], codec, start)


def _sources(passes: list[_Pass], taken: list[tuple[_Pass, int]]) -> list[int]:
    """The index of each field among the items of all passes."""
    firsts, first = {}, 0
    for one in passes:
        firsts[one] = first
        first += one.items
    return [firsts[one] + place for one, place in taken]
