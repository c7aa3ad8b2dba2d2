"""Writes tags: everything is checked before anything is sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast.client import requests
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
    value: Any
    """The value, scaled as in the tag list, or the name of a state."""
    raw: Any
    """What the registers have to hold."""
    request: Request

    def send(self, client: SyncClient) -> None:
        """Writes the value. Raises `ModbusError`."""
        tag = self.tag
        client.write(tag.area, tag.address, self.raw, tag.type, tag.order, encoding=tag.encoding)

    def read_back(self, client: SyncClient) -> tuple[bool, Any]:
        """Whether the device has the value now, and which it has. Raises `ModbusError`."""
        tag = self.tag
        now = client.read(tag.area, tag.address, tag.type, tag.order, encoding=tag.encoding)
        return now == self._as_read(), tag.value(now)

    def _as_read(self) -> Any:
        """The raw value after a way through registers, which round floats and pad text."""
        tag = self.tag
        if tag.of_type.base in ("bool", "bit"):
            return self.raw
        registers = values.encode(self.raw, tag.type, tag.order, encoding=tag.encoding)
        return values.decode(registers, tag.type, tag.order, encoding=tag.encoding)


def prepared(tags: TagList, texts: Iterable[tuple[str, str]]) -> list[TagWrite]:
    """Checks names and values of tags as text. Raises `ValueError`, `KeyError` for a name."""
    found: dict[str, TagWrite] = {}
    for name, text in texts:
        if name in found:
            raise ValueError(f"{name}: given twice")
        if name not in tags:
            raise KeyError(name)
        try:
            found[name] = _checked(tags[name], text)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return list(found.values())


def _checked(tag: Tag, text: str) -> TagWrite:
    if not tag.writable:
        raise ValueError(f"{tag.unwritable or 'not writable in the tag list'}")
    value = value_from(tag, text)
    raw = tag.raw(value)
    steps = requests.write_typed(
        tag.area, tag.address, raw, tag.type, tag.order, tag.encoding, split=False
    )
    [request] = steps
    return TagWrite(tag, value, raw, request)
