"""Decodes the bytes of blocks to what the registers of tags hold.

Decoders are compiled once per block.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

from holdfast.tags.base import BaseTag, Scaled
from holdfast.values import ConversionError, Field, Layout, decode
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.types import Area

Decoder: TypeAlias = Callable[[bytes], Sequence[Any]]

MAX_CACHED_LAYOUTS = 1024
"""The size of the cache of layouts."""

_BITS = [tuple(bool(byte >> bit & 1) for bit in range(8)) for byte in range(256)]


T = TypeVar("T", bound=BaseTag)


class Places(Generic[T]):
    """An index of tags by address, to find the tags of a block quickly."""

    def __init__(self, tags: Iterable[T]) -> None:
        self._tags: dict[Area, list[tuple[int, T]]] = {}
        """Tags with the ends of their spans."""
        self._starts: dict[Area, list[int]] = {}
        spans = [(tag.span, tag) for tag in tags]
        for span, tag in sorted(spans, key=lambda each: each[0].start):
            self._tags.setdefault(tag.area, []).append((span.stop, tag))
            self._starts.setdefault(tag.area, []).append(span.start)

    def inside(self, area: Area, address: int, count: int) -> list[T]:
        """Returns the tags that are entirely inside a block, with their scales."""
        starts, end = self._starts.get(area, []), address + count
        first, last = bisect_left(starts, address), bisect_left(starts, end)
        return [tag for stop, tag in self._tags.get(area, [])[first:last] if stop <= end]


class Undecoded:
    """Stands for a value whose registers can't be decoded."""

    def __init__(self, error: str) -> None:
        self.error = error


def decoder(tags: Sequence[BaseTag], address: int, count: int) -> Decoder:
    """Returns a decoder for tags of one area, which must all be inside the block."""
    if tags[0].of_bits:
        return _bits(tags, address)
    if any(tag.source is not None for tag in tags):
        return _with_scales(tags, address, count)
    return _registers(tags, address, count)


def _with_scales(tags: Sequence[BaseTag], address: int, count: int) -> Decoder:
    """A decoder for tags of which some have their scale in the same block."""
    sources: dict[tuple[int, str, str], BaseTag] = {}
    for tag in tags:
        if tag.source is not None:
            sources.setdefault(_place(tag.source), tag.source)
    numbers = {place: at for at, place in enumerate(sources, len(tags))}
    scales = [None if tag.source is None else numbers[_place(tag.source)] for tag in tags]
    decode = _registers([*tags, *sources.values()], address, count)

    def decoded(data: bytes) -> Sequence[Any]:
        found = decode(data)
        return [
            raw if at is None else _scaled(tag, raw, found[at])
            for tag, raw, at in zip(tags, found, scales, strict=False)
        ]

    return decoded


def _place(source: BaseTag) -> tuple[int, str, str]:
    return source.address, source.type, source.order


def _scaled(tag: BaseTag, raw: Any, content: Any) -> Scaled | Undecoded:
    if type(raw) is Undecoded:
        return raw
    if type(content) is Undecoded:
        return Undecoded(f"the scale: {content.error}")
    try:
        return tag.scaled(raw, content)
    except ValueError as error:
        return Undecoded(str(error))


def _registers(tags: Sequence[BaseTag], address: int, count: int) -> Decoder:
    """A decoder for registers that are all inside the block."""
    layout = _layout(
        count, *((tag.type, tag.address - address, tag.order, tag.encoding) for tag in tags)
    )

    def decoded(data: bytes) -> Sequence[Any]:
        try:
            return layout.decode_tuple(data)
        except ConversionError:
            return [_alone(tag, data, address) for tag in tags]

    return decoded


@lru_cache(MAX_CACHED_LAYOUTS)
def _layout(count: int, *fields: tuple[str, int, str, str | None]) -> Layout:
    """Returns the layout of a block. Cached, because devices of one kind share their layouts."""
    named = [Field(f"{at}", *field) for at, field in enumerate(fields)]
    return Layout(named, size=count)


def value_of(tag: BaseTag, data: bytes, address: int) -> Any:
    """Decodes one tag of a block that begins at `address`."""
    if tag.of_bits:
        [value] = _bits([tag], address)(data)
        return value
    raw = _alone(tag, data, address)
    source = tag.source
    return raw if source is None else _scaled(tag, raw, _alone(source, data, address))


def assembled(
    tag: BaseTag, parts: Sequence[range], pieces: Sequence[tuple[int, int, bytes]]
) -> bytes | None:
    """The bytes of a tag that several requests have read; `None` if something is missing.

    `pieces` are addresses, counts and bytes. Each of the `parts` of the tag is from one of them.
    """
    bits: list[bool] = []
    registers = bytearray()
    # Both are in the order of addresses, though pieces may begin in the middle: the piece of a part
    # is that of the part before, or the next one.
    at = 0
    for part in parts:
        for _ in pieces:
            address, count, data = pieces[at]
            first, last = part.start - address, part.stop - address
            if first >= 0 and last <= count:
                break
            at = (at + 1) % len(pieces)
        else:
            return None
        if tag.of_bits:
            bits += _unpacked(data)[first:last]
        else:
            registers += data[2 * first : 2 * last]
    return packed(bits) if tag.of_bits else bytes(registers)


def packed(bits: Sequence[bool]) -> bytes:
    """Bits as in a Modbus reply."""
    together = sum(bit << at for at, bit in enumerate(bits))
    return together.to_bytes((len(bits) + 7) // 8, "little")


def _alone(tag: BaseTag, data: bytes, address: int) -> Any:
    """Decodes one tag, independently of the others."""
    start = 2 * (tag.address - address)
    try:
        return decode(
            data[start : start + 2 * tag.count], tag.type, tag.order, encoding=tag.encoding
        )
    except ConversionError as error:
        return Undecoded(str(error))


def _bits(tags: Sequence[BaseTag], address: int) -> Decoder:
    starts = [tag.address - address for tag in tags]
    places = [
        start if parsed(tag.type).count is None else slice(start, start + tag.count)
        for start, tag in zip(starts, tags, strict=True)
    ]

    def decoded(data: bytes) -> Sequence[Any]:
        bits = _unpacked(data)
        return [bits[place] for place in places]

    return decoded


def _unpacked(data: bytes) -> list[bool]:
    return list(chain.from_iterable(map(_BITS.__getitem__, data)))
