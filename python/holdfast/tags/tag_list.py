"""A tag list: the tags of a device, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.tags.tag import Tag, TagError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


class TagList:
    """The tags of a device, in their order.

    Raises `TagError` for two tags of one name, and for a scale that no tag of the list has.
    """

    def __init__(self, tags: Iterable[Tag] = ()) -> None:
        self._tags: dict[str, Tag] = {}
        for tag in tags:
            if tag.name in self._tags:
                raise TagError("name", f"two tags have the name {tag.name!r}")
            self._tags[tag.name] = tag
        for name, tag in self._tags.items():
            self._tags[name] = tag.resolved(self._tags)

    def __iter__(self) -> Iterator[Tag]:
        return iter(self._tags.values())

    def __len__(self) -> int:
        return len(self._tags)

    def __contains__(self, name: object) -> bool:
        return name in self._tags

    def __getitem__(self, name: str) -> Tag:
        return self._tags[name]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TagList) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"TagList({list(self)!r})"
