"""Decodes the bytes of blocks to values. Decoders are compiled once per block. Does no I/O."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.values import ConversionError, Field, Layout, decode
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.scanner.tags import Tag

Decoder: TypeAlias = Callable[[bytes], Sequence[Any]]

LAYOUTS = 1024
"""The size of the cache of layouts."""

_BITS = [tuple(bool(byte >> bit & 1) for bit in range(8)) for byte in range(256)]


class Undecoded:
    """Stands for a value whose registers can't be decoded."""

    def __init__(self, error: str) -> None:
        self.error = error


def decoder(tags: Sequence[Tag], address: int, count: int) -> Decoder:
    """Returns a decoder for tags of one area, which must all be inside the block."""
    if tags[0].of_bits:
        return _bits(tags, address)
    layout = _layout(
        count, *((tag.type, tag.address - address, tag.order, tag.encoding) for tag in tags)
    )

    def decoded(data: bytes) -> Sequence[Any]:
        try:
            return layout.decode_tuple(data)
        except ConversionError:
            return [_alone(tag, data, address) for tag in tags]

    return decoded


@lru_cache(LAYOUTS)
def _layout(count: int, *fields: tuple[str, int, str, str | None]) -> Layout:
    """Returns the layout of a block. Cached, because devices of one kind share their layouts."""
    named = [Field(f"{at}", *field) for at, field in enumerate(fields)]
    return Layout(named, size=count)


def value_of(tag: Tag, data: bytes, address: int) -> Any:
    """Decodes one tag of a block that begins at `address`."""
    if not tag.of_bits:
        return _alone(tag, data, address)
    return _bits([tag], address)(data)[0]


def clean(value: Any, tag: Tag) -> Any:
    """Returns the value; `None` for NaN and for markers of the tag."""
    if type(value) is list:
        return [clean(item, tag) for item in value]
    if type(value) is float and value != value:
        return None
    if tag.null and type(value) is not Undecoded and value in tag.null:
        return None
    return value


def _alone(tag: Tag, data: bytes, address: int) -> Any:
    """Decodes one tag, independently of the others."""
    start = 2 * (tag.address - address)
    try:
        return decode(
            data[start : start + 2 * tag.count], tag.type, tag.order, encoding=tag.encoding
        )
    except ConversionError as error:
        return Undecoded(str(error))


def _bits(tags: Sequence[Tag], address: int) -> Decoder:
    places = [tag.address - address for tag in tags]
    if any(parsed(tag.type).count is not None for tag in tags):
        spans = [
            slice(place, place + tag.count) if parsed(tag.type).count is not None else place
            for place, tag in zip(places, tags, strict=True)
        ]
        return lambda data: [_unpacked(data)[span] for span in spans]

    def decoded(data: bytes) -> Sequence[Any]:
        bits = _unpacked(data)
        return [bits[place] for place in places]

    return decoded


def _unpacked(data: bytes) -> list[bool]:
    return list(chain.from_iterable(map(_BITS.__getitem__, data)))
