"""The tags of a command: those of its arguments, and the choice of `--only`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli.options import item
from holdfast.runtime.suggestion import suggestion
from holdfast.tags import Tag, TagError, TagList
from holdfast.types import BIT_AREAS, SHORT_OF
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.cli.options.item import Item
    from holdfast.types import Area

MAX_TAGS = 8192
"""Maximum number of values of a command: more fit on no screen."""


@dataclass(frozen=True)
class TaggedDevice:
    """A device, and the tags that a command uses."""

    url: str
    unit: int
    timeout: float
    tags: TagList


class _ItemTag(Tag):
    """An item. Its bytes are in hex, as with `--type` and as `write` takes them."""

    def value(self, raw: Any) -> Any:
        """What the registers hold."""
        return raw.hex() if isinstance(raw, bytes) else super().value(raw)


def chosen(tags: TagList, only: Sequence[str]) -> TagList:
    """The tags whose names match one of the patterns of `--only`; all without patterns."""
    names = [tag.name for tag in tags]
    for pattern in only:
        if not any(fnmatchcase(name, pattern) for name in names):
            hint = suggestion(pattern, names)
            raise click.UsageError(f"No tag has the name {pattern!r}{hint}")
    if not only:
        return tags
    return TagList(tag for tag in tags if any(fnmatchcase(tag.name, pattern) for pattern in only))


def items(words: Sequence[str], *, encoding: str | None) -> TagList:
    """Parses items; an array, or FIRST-LAST, is one tag for each element."""
    found: list[tuple[Tag, str]] = []
    left = list(words)
    while left:
        each, left = item.take(left)
        found += _item(each, encoding)
        if len(found) > MAX_TAGS:
            raise click.UsageError(f"{each.text!r}: more than {MAX_TAGS} values.")
    names = Counter(tag.name for tag, _ in found)
    try:
        return TagList(
            replace(tag, name=full) if names[tag.name] > 1 else tag for tag, full in found
        )
    except TagError as error:
        raise click.UsageError(str(error)) from error


def _item(each: Item, encoding: str | None) -> Iterable[tuple[Tag, str]]:
    """The tags of an item, and their names with type and order."""
    place, kind, order = each.place, each.type or "", each.order
    if each.count is not None:
        kind = f"{'bool' if place.area in BIT_AREAS else 'uint16'}[{each.count}]"
    try:
        whole = _tag(place.area, place.address, kind, order, encoding)
        of = parsed(whole.type)
        if of.count is None:
            return [_named(whole)]
        if of.count > MAX_TAGS:
            raise click.UsageError(f"{each.text!r}: more than {MAX_TAGS} values.")
        width = whole.count // of.count
        return [
            _named(_tag(place.area, place.address + at * width, of.element, order, encoding))
            for at in range(of.count)
        ]
    except TagError as error:
        raise click.UsageError(f"{each.text!r}: {error}") from error


def _tag(area: Area, address: int, kind: str, order: str, encoding: str | None) -> Tag:
    text = encoding if kind.startswith("string") else None
    return _ItemTag(f"{SHORT_OF[area]}:{address}", area, address, kind, order, text)


def _named(tag: Tag) -> tuple[Tag, str]:
    order = "" if tag.order == "ABCD" else f":{tag.order}"
    return tag, f"{tag.name}:{tag.type}{order}"
