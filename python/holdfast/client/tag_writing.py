"""Writes tags: everything is checked before anything is sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast.client import requests
from holdfast.tags.decoding import Undecoded, value_of
from holdfast.tags.text import value_from

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast._core import Request
    from holdfast.client import SyncClient
    from holdfast.tags import Tag, TagList


@dataclass(frozen=True)
class TagWrite:
    """A value to write."""

    tag: Tag
    """With the scale that was read, if a register contains it."""
    value: Any
    """The value, scaled as in the tag list, or the name of a state."""
    raw: Any
    """What the registers have to hold."""
    request: Request
    scaled: Tag | None = None
    """The tag of the list, if a register contains its scale."""
    content: Any = None
    """What that register contained before the write."""

    def send(self, client: SyncClient) -> None:
        """Writes the value. Raises `ModbusError`."""
        tag = self.tag
        client.write(tag.area, tag.address, self.raw, tag.type, tag.order, encoding=tag.encoding)

    def read_back(self, client: SyncClient) -> tuple[bool, Any]:
        """Whether the device has the value now, and which it has. Raises `ModbusError`."""
        tag, scaled = self.tag, self.scaled
        if scaled is not None:
            found = _value_now(client, scaled)
            wrote = scaled.scaled(self._as_read(), self.content)
            return found == scaled.value(wrote), found
        now = client.read(tag.area, tag.address, tag.type, tag.order, encoding=tag.encoding)
        return now == self._as_read(), tag.value(now)

    def _as_read(self) -> Any:
        """The raw value after a way through registers, which round floats and pad text."""
        tag = self.tag
        if tag.of_type.base in ("bool", "bit"):
            return self.raw
        registers = values.encode(self.raw, tag.type, tag.order, encoding=tag.encoding)
        return values.decode(registers, tag.type, tag.order, encoding=tag.encoding)


def prepared(
    tags: TagList, texts: Iterable[tuple[str, str]], client: SyncClient | None = None
) -> list[TagWrite]:
    """Checks names and values of tags as text. Nothing is written.

    Scales that registers contain are read by the `client`; without one, their tags are refused.
    Raises `ValueError`, `KeyError` for a name, and `ModbusError` if a scale can't be read.
    """
    texts = list(texts)
    found: dict[str, TagWrite] = {}
    for name, text in texts:
        if name in found:
            raise ValueError(f"{name}: given twice")
        if name not in tags:
            raise KeyError(name)
        others = [tags[other] for other, _ in texts if other in tags]
        try:
            found[name] = _checked(tags[name], text, others, client)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return list(found.values())


def _checked(tag: Tag, text: str, others: Iterable[Tag], client: SyncClient | None) -> TagWrite:
    if not tag.writable:
        raise ValueError(f"{tag.unwritable or 'not writable in the tag list'}")
    scaled, source, content = tag, tag.source, None
    if source is not None and client is not None:
        changed = [other.name for other in others if _overlap(other, source)]
        if changed:
            raise ValueError(f"{changed[0]} changes its scale, allowed: one write after the other")
        content = client.read(source.area, source.address, source.type, source.order)
        tag = tag.with_scale(content)
    value = value_from(tag, text)
    raw = tag.raw(value)
    steps = requests.write_typed(
        tag.area, tag.address, raw, tag.type, tag.order, tag.encoding, split=False
    )
    [request] = steps
    return TagWrite(tag, value, raw, request, None if source is None else scaled, content)


def _overlap(one: Tag, other: Tag) -> bool:
    return one.area == other.area and one.address < other.end and other.address < one.end


def _value_now(client: SyncClient, tag: Tag) -> Any:
    """The value of a tag and its scale, from one request; `None` if they are not valid."""
    first, count = tag.span.start, len(tag.span)
    data = client.read(tag.area, first, f"bytes:{2 * count}")
    found = value_of(tag, data, first)
    return None if type(found) is Undecoded else tag.value(found)
