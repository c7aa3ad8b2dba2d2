"""From the polls of a device to its messages: what is due, as text for NATS.

The blocks of a device are nearly always the same. For those, `_Part` holds all that does not depend
on the values: where they are, and the text around them. A value then costs its own JSON and one
formatting of bytes. Nothing here does I/O.
"""

from __future__ import annotations

import math
from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import msgspec

from holdfast.scanner.decoding import Undecoded, decoder
from holdfast.scanner.groups import Group

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from holdfast.scanner.decoding import Decoder
    from holdfast.scanner.polling import Block
    from holdfast.scanner.tags import Tag

Shape: TypeAlias = tuple[tuple[str, int, int], ...]
Message: TypeAlias = tuple[str, bytes]
"""The id of a tag, and the text that publishes its value."""

SHAPES = 64
"""Sets of blocks that are remembered; a device that refuses some has more than one."""

SLACK = 0.0005
"""Seconds that two times of a schedule may be off: they were reckoned in nanoseconds."""

_UNKNOWN = object()
_encode = msgspec.json.Encoder().encode


class Publisher:
    """The messages of one device."""

    def __init__(self, prefix: str, device: str) -> None:
        self._prefix = prefix
        self._device = device
        self._groups: list[_Due] = []
        self._shapes: dict[Shape, list[tuple[_Due, list[_Part]]]] = {}
        self._fresh: set[str] = set()
        """Tags that were never published."""
        self._last: dict[str, Any] = {}
        """The values that were published last, of tags whose changes somebody wants."""
        self.undecoded: dict[str, str] = {}
        """Why tags have no value though their registers were read."""

    def regroup(self, groups: Sequence[Group], newcomers: set[str]) -> None:
        """Publishes these groups from now on; of newcomers the next value, changed or not."""
        before = {(due.group.change, due.group.rate): due for due in self._groups if not due.once}
        known = {tag.id for due in before.values() for tag in due.group.tags} - self._fresh
        self._fresh = {tag.id for group in groups for tag in group.tags} - known
        self._groups = [
            *(_Due(group, None, once=True) for group in self._firsts(groups, before)),
            *(_Due(group, before.get((group.change, group.rate))) for group in groups),
        ]
        ids = {tag.id for group in groups for tag in group.tags if group.change}
        self._last = {id: value for id, value in self._last.items() if id in ids - newcomers}
        for id in ids:
            self._last.setdefault(id, _UNKNOWN)
        self.undecoded.clear()
        self._shapes.clear()

    def messages(self, due: float, blocks: Sequence[Block]) -> list[Message]:
        """What is to be published after a poll that the schedule wanted at this time in seconds."""
        shape = tuple(block[:3] for block in blocks if block[3] is not None)
        parts = self._shapes.get(shape)
        if parts is None:
            parts = self._compiled(shape)
        answered = [
            (block[3], b"%d" % (block[5] * 1000)) for block in blocks if block[3] is not None
        ]
        made: list[Message] = []
        first: set[str] = set()
        for group, compiled in parts:
            if not compiled or not group.now(due):
                continue
            for part in compiled:
                found = self._made(part, *answered[part.block])
                if first and not group.once:
                    found = (message for message in found if message[0] not in first)
                made += found
            if group.once:
                first = {id for id, _ in made}
        if self._fresh and any(compiled for _, compiled in parts):
            self._forget_firsts()
        return made

    def _firsts(
        self, groups: Sequence[Group], before: Mapping[tuple[bool, int], _Due]
    ) -> Iterator[Group]:
        """Groups for the first values of new tags, which need not wait until their group is due."""
        for group in groups:
            tags = tuple(tag for tag in group.tags if tag.id in self._fresh)
            if tags and (group.change, group.rate) in before:
                yield Group(group.rate, False, tags, (0.0,) * len(tags))

    def _forget_firsts(self) -> None:
        """The first values have been published."""
        self._fresh.clear()
        if any(due.once for due in self._groups):
            self._groups = [due for due in self._groups if not due.once]
            self._shapes.clear()

    def _made(self, part: _Part, data: bytes, timestamp: bytes) -> Iterable[Message]:
        """The messages of the tags of one group in one block."""
        values = part.decoder(data)
        if part.special:
            values = [_clean(value, tag) for value, tag in zip(values, part.tags, strict=True)]
        if part.plain:
            texts = _encode(values)[1:-1].split(b",")
        else:
            texts = [b"" if type(value) is Undecoded else _encode(value) for value in values]
        rows: Iterator[Any] = zip(part.ids, part.lengths, part.templates, texts, strict=True)
        if part.picky:
            rows = compress(rows, self._picked(part, values))
        digits = len(timestamp)
        return (
            (id, template % (length + digits + len(text), text, timestamp))
            for id, length, template, text in rows
        )

    def _picked(self, part: _Part, values: Sequence[Any]) -> list[bool]:
        """Which values are to be published: those that can be, of a change group the changed."""
        picked = []
        for id, value, deadband in zip(part.ids, values, part.deadbands, strict=True):
            if type(value) is Undecoded:
                self.undecoded[id] = value.error
                picked.append(False)
                continue
            self.undecoded.pop(id, None)
            last = self._last.get(id, _UNKNOWN)
            wanted = not part.change or _differs(value, last, deadband)
            if wanted and id in self._last:
                self._last[id] = value
            picked.append(wanted)
        return picked

    def _compiled(self, shape: Shape) -> list[tuple[_Due, list[_Part]]]:
        """The parts of all groups for the blocks that came; each tag is taken from the first."""
        if len(self._shapes) >= SHAPES:
            self._shapes.clear()
        parts = [(due, list(self._parts(due.group, shape))) for due in self._groups]
        self._shapes[shape] = parts
        return parts

    def _parts(self, group: Group, shape: Shape) -> Iterator[_Part]:
        left = dict(zip(group.tags, group.deadbands, strict=True))
        for index, (area, address, count) in enumerate(shape):
            tags = [
                tag
                for tag in left
                if tag.area == area and tag.address >= address and tag.end <= address + count
            ]
            if tags:
                made = decoder(tags, address, count)
                yield self._part(group, tags, [left.pop(tag) for tag in tags], index, made)

    def _part(
        self, group: Group, tags: list[Tag], deadbands: list[float], block: int, made: Decoder
    ) -> _Part:
        texts = [_template(self._prefix, self._device, tag) for tag in tags]
        infallible = all(tag.type in _INFALLIBLE for tag in tags)
        remembered = group.change or any(tag.id in self._last for tag in tags)
        return _Part(
            block,
            made,
            tags,
            [tag.id for tag in tags],
            [text for text, _ in texts],
            [length for _, length in texts],
            deadbands,
            plain=infallible,
            special=remembered or any(tag.null for tag in tags),
            change=group.change,
            picky=remembered or not infallible,
        )


_INFALLIBLE = {
    "bool",
    *(f"bit:{bit}" for bit in range(16)),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (16, 32, 64)),
    *(f"float{bits}" for bits in (16, 32, 64)),
}
"""Types that any registers are a value of, and whose values are one JSON number or word."""


class _Part(NamedTuple):
    """The tags of a group that are in one block."""

    block: int
    decoder: Decoder
    tags: Sequence[Tag]
    ids: Sequence[str]
    templates: Sequence[bytes]
    """With places for the length, the value and the time."""
    lengths: Sequence[int]
    """Of the payloads without values and times."""
    deadbands: Sequence[float]
    plain: bool
    """Whether the JSON of all values can be made at once, and cut at the commas."""
    special: bool
    """Whether some values mean something else."""
    change: bool
    picky: bool
    """Whether some values may be left out, or have to be remembered."""


class _Due:
    """A group, and when it is published next."""

    def __init__(self, group: Group, before: _Due | None, *, once: bool = False) -> None:
        self.group = group
        self.once = once
        self._last: float = -math.inf if before is None else before._last

    def now(self, due: float) -> bool:
        """Whether it is published with the values of this scan, which is noted then."""
        if due < self._last + self.group.rate / 1000 - SLACK:
            return False
        self._last = due
        return True


def _template(prefix: str, device: str, tag: Tag) -> tuple[bytes, int]:
    """The text that publishes a value, with places for what changes; the length of the rest."""
    head = {"moduleId": prefix, "deviceId": device, "variableId": tag.id}
    before = _encode(head)[:-1] + b',"value":'
    after = b',"datatype":"%b","timestamp":' % tag.datatype.encode()
    text = before.replace(b"%", b"%%") + b"%b" + after + b"%b}"
    subject = f"{prefix}.data.{device}".replace("%", "%%").encode()
    return b"PUB %b %%d\r\n%b\r\n" % (subject, text), len(before) + len(after) + 1


def _clean(value: Any, tag: Tag) -> Any:
    """A value, or `None` if it means that there is none."""
    if type(value) is list:
        return [_clean(item, tag) for item in value]
    if type(value) is float and value != value:
        return None
    if tag.null and type(value) is not Undecoded and value in tag.null:
        return None
    return value


def _differs(value: Any, last: Any, deadband: float) -> bool:
    """Whether a value is another one, a number by more than the deadband."""
    if type(value) in (int, float) and type(last) in (int, float):
        # The difference of two equal infinities is NaN, which is no more than anything.
        return bool(abs(value - last) > deadband)
    return bool(value is not last and value != last)
