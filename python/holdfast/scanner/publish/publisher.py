"""Converts the polls of a device to messages that are due, as text for NATS. Does no I/O.

The blocks of a device nearly always have the same shape. For each shape, `_BlockPart` caches
everything that does not depend on the values: their places, and the text around them. A value then
costs only its own JSON and joining it with them.
"""

from __future__ import annotations

from itertools import compress, repeat
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import msgspec

from holdfast.net.nats import batch
from holdfast.scanner.dialects import TENTACLE, Dialect
from holdfast.scanner.messages.types import Data
from holdfast.scanner.publish.due_time import DueTime
from holdfast.scanner.subscriptions.groups import Group
from holdfast.tags.deadband import differs
from holdfast.tags.decoding import Places, Undecoded, decoder

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence, Set

    from holdfast.scanner.subscriptions.tag import ScannedTag
    from holdfast.tags.decoding import Decoder
    from holdfast.types import Area, PolledBlock

Place: TypeAlias = "tuple[Area, int, int]"
"""Area, address and count of a block."""

Shape: TypeAlias = tuple[Place, ...]
_Template: TypeAlias = tuple[bytes, int, bytes, bytes]
"""A message around its value: what precedes the size of the payload, the size without value and
time, and what is before and after the value."""
Message: TypeAlias = tuple[str, bytes]
"""The id of a tag, and the text that publishes its value."""

MAX_SHAPES = 64
"""Limit of cached shapes. A device that refuses some blocks has more than one shape."""

_UNKNOWN = object()
_encode = msgspec.json.Encoder().encode


class Publisher:
    """Creates the messages of one device."""

    def __init__(
        self, prefix: str, device: str, dialect: Dialect = TENTACLE, lease: int | None = None
    ) -> None:
        """In a fleet, messages have the revision of the `lease` of the device."""
        self._lease = lease
        self._header = b"" if lease is None else batch.lease_header(lease)
        self._prefix = prefix
        self._device = device
        self._dialect = dialect
        self.second_subject = dialect.second_data_subject(prefix, device)
        """The subject under which all messages are published again, if any."""
        self._new_groups: Callable[[], Sequence[Group]] | None = None
        """Returns the groups from the next poll on; `None` if they have not changed."""
        self._new_tags: set[str] = set()
        self._repeat_all = False
        self._groups: list[_ScheduledGroup] = []
        self._shapes: dict[Shape, list[tuple[_ScheduledGroup, list[_Placed]]]] = {}
        self._fresh: set[str] = set()
        """Tags whose next value is published even if it is not due."""
        self._last: dict[str, Any] = {}
        """The last published values of tags in groups that publish changes."""
        self.undecoded: dict[str, str] = {}
        """The errors of tags whose registers were read but can't be decoded."""

    def update(self, groups: Callable[[], Sequence[Group]], new_tags: Iterable[str] = ()) -> None:
        """Changes the groups from the next poll on. Combines all changes before that poll."""
        self._new_groups = groups
        self._new_tags.update(new_tags)

    def repeat_all(self, lease: int | None = None) -> None:
        """Publishes the next values of all tags, even if they are unchanged or not due.

        In a fleet, messages have the revision `lease` from now on.
        """
        self._repeat_all = True
        if lease is None or lease == self._lease:
            return
        self._lease, self._header = lease, batch.lease_header(lease)
        self._shapes.clear()
        for scheduled in self._groups:
            scheduled.parts.clear()

    def regroup(self, groups: Sequence[Group], new_tags: Collection[str]) -> None:
        """Changes the groups now. The next value of `new_tags` is published even if unchanged."""
        # A group with the same rate and mode keeps the time of its last publication: a new
        # subscriber must not shift the times of the others.
        before = {
            (scheduled.group.change, scheduled.group.rate): scheduled
            for scheduled in self._groups
            if not scheduled.is_once
        }
        tags = {tag.id: tag for group in groups for tag in group.tags}
        known = {
            tag.id for scheduled in before.values() for tag in scheduled.group.tags
        } - self._fresh
        self._fresh = (tags.keys() - known) | (tags.keys() & new_tags)
        ids = {tag.id for group in groups for tag in group.tags if group.change}
        same = ids == self._last.keys()
        self._last = {id: self._last.get(id, _UNKNOWN) for id in ids}
        self._last |= dict.fromkeys(ids & self._fresh, _UNKNOWN)
        self._groups = []
        for group in groups:
            scheduled = before.get((group.change, group.rate))
            if scheduled is None or not same or scheduled.group != group:
                scheduled = _ScheduledGroup(group, scheduled)
            self._groups.append(scheduled)
        publish_now = {
            id for scheduled in self._groups for id in scheduled.publish_now(self._fresh)
        }
        self._schedule_first_values(self._fresh - publish_now)
        # Tags that are not published any more have no error any more.
        for id in self.undecoded.keys() - tags.keys():
            del self.undecoded[id]

    def _apply_updates(self) -> None:
        """Applies the changes that were requested since the last poll."""
        # The groups are computed here, and not with each request: a caller may subscribe to a
        # thousand tags one by one.
        groups = None if self._new_groups is None else self._new_groups()
        if groups is None and self._repeat_all:
            groups = [scheduled.group for scheduled in self._groups if not scheduled.is_once]
        if groups is None:
            return
        new_tags = self._new_tags
        if self._repeat_all:
            new_tags = {tag.id for group in groups for tag in group.tags}
        self.regroup(groups, new_tags)
        self._new_groups, self._new_tags, self._repeat_all = None, set(), False

    def messages(self, due: float, blocks: Sequence[PolledBlock]) -> list[Message]:
        """Returns the messages after a poll. `due` is its scheduled time in seconds."""
        self._apply_updates()
        shape = tuple(block[:3] for block in blocks if block[3] is not None)
        # The shape depends on the blocks that were read, so a refused block changes it.
        parts = self._shapes.get(shape)
        if parts is None:
            parts = self._compiled(shape)
        answered = [
            (block[3], b"%d" % (block[5] * 1000)) for block in blocks if block[3] is not None
        ]
        messages: list[Message] = []
        first: set[str] = set()
        for group, compiled in parts:
            if not compiled or not group.due_time.claim(due):
                continue
            for block, part in compiled:
                found = self._part_messages(part, *answered[block])
                # The group for first values comes first; no tag is published twice in one poll.
                if first and not group.is_once:
                    found = [message for message in found if message[0] not in first]
                messages += found
            if group.is_once:
                first = {id for id, _ in messages}
        if self._fresh and any(id in self._fresh for id, _ in messages):
            self._fresh.difference_update(id for id, _ in messages)
            self._schedule_first_values(self._fresh)
        return messages

    def _schedule_first_values(self, ids: Set[str]) -> None:
        """Publishes the next values of these tags even if their groups are not due."""
        groups = [due for due in self._groups if not due.is_once]
        tags = {tag.id: tag for due in groups for tag in due.group.tags if tag.id in ids}
        if tags:
            first = Group(0, False, tuple(tags.values()), (0.0,) * len(tags))
            groups.insert(0, _ScheduledGroup(first, None, is_once=True))
        self._groups = groups
        self._shapes.clear()

    def _part_messages(self, part: _BlockPart, data: bytes, timestamp: bytes) -> list[Message]:
        """Returns the messages of the tags of one group in one block."""
        values = part.decoder(data)
        if part.needs_cleaning:
            values = [tag.value(raw) for raw, tag in zip(values, part.tags, strict=True)]
        selected = self._filtered(part, values) if part.needs_filter else repeat(True)
        if part.has_profile_tags:  # What is not published does not need its digits.
            values = [
                tag.published(value) if is_published and type(value) is not Undecoded else value
                for value, tag, is_published in zip(values, part.tags, selected, strict=False)
            ]
        if part.is_plain_json:  # One call for all values, instead of one for each.
            texts = _encode(values)[1:-1].split(b",")
        else:
            texts = [b"null" if type(value) is Undecoded else _encode(value) for value in values]
        rows: Iterator[Any] = compress(zip(part.ids, part.templates, texts, strict=True), selected)
        end, digits = timestamp + b"}\r\n", len(timestamp)
        join, sizes = b"".join, _SIZES
        return [
            (id, join((head, sizes[length + digits + len(text)], before, text, after, end)))
            for id, (head, length, before, after), text in rows
        ]

    def _filtered(self, part: _BlockPart, values: Sequence[Any]) -> list[bool]:
        """Returns which values to publish; in a group that publishes changes, the changed ones.

        Records errors of decoding. An undecoded value counts as no value.
        """
        selected = []
        for id, value, deadband in zip(part.ids, values, part.deadbands, strict=True):
            if type(value) is Undecoded:
                self.undecoded[id] = value.error
                value = None
            else:
                self.undecoded.pop(id, None)
            last = self._last.get(id, _UNKNOWN)
            is_published = not part.change or differs(value, last, deadband)
            if is_published and id in self._last:
                self._last[id] = value
            selected.append(is_published)
        return selected

    def _compiled(self, shape: Shape) -> list[tuple[_ScheduledGroup, list[_Placed]]]:
        """Compiles the parts of all groups for a shape. Each tag is read from its first block."""
        # Clearing all is enough: a usual device has few shapes, which are compiled again.
        if len(self._shapes) >= MAX_SHAPES:
            self._shapes.clear()
        parts = [
            (scheduled, list(self._block_parts(scheduled, shape))) for scheduled in self._groups
        ]
        self._shapes[shape] = parts
        return parts

    def _block_parts(self, scheduled: _ScheduledGroup, shape: Shape) -> Iterator[_Placed]:
        covered: set[str] = set()
        for index, block in enumerate(shape):
            part = scheduled.parts.get(block)
            if part is None or not covered.isdisjoint(part.ids):
                inside = scheduled.places.inside(*block)
                tags = [tag for tag in inside if tag.id not in covered]
                if not tags:
                    continue
                part = self._block_part(scheduled, tags, block)
                # Only a complete part is cached: an incomplete one depends on the other blocks.
                if len(tags) == len(inside):
                    scheduled.keep(block, part)
            covered.update(part.ids)
            yield index, part

    def _block_part(
        self, scheduled: _ScheduledGroup, tags: list[ScannedTag], block: Place
    ) -> _BlockPart:
        _, address, count = block
        group = scheduled.group
        is_infallible = all(tag.type in _INFALLIBLE_TYPES and tag.source is None for tag in tags)
        remembered = group.change or any(tag.id in self._last for tag in tags)
        return _BlockPart(
            decoder(tags, address, count),
            tags,
            [tag.id for tag in tags],
            [self._template(tag) for tag in tags],
            [scheduled.deadbands[tag.id] for tag in tags],
            is_plain_json=is_infallible,
            needs_cleaning=remembered
            or any(tag.null or tag.profile_tag is not None for tag in tags),
            has_profile_tags=any(tag.profile_tag is not None for tag in tags),
            change=group.change,
            needs_filter=remembered or not is_infallible,
        )

    def _template(self, tag: ScannedTag) -> _Template:
        message = _encode(Data(self._prefix, self._device, tag.id, None, tag.datatype, 0))
        # What follows the value has no `null`, whatever the ids have.
        before, _, rest = message.rpartition(b"null")
        after = rest.removesuffix(b"0}")
        subject = self._dialect.data_subject(self._prefix, self._device, tag.id).encode()
        header = self._header
        head = b"HPUB %b %d " % (subject, len(header)) if header else b"PUB %b " % subject
        length = len(header) + len(before) + len(after) + len(b"}")
        return head, length, b"\r\n" + header + before, after


class _Sizes(dict[int, bytes]):
    """The sizes of payloads as text."""

    def __missing__(self, size: int) -> bytes:
        text = self[size] = b"%d" % size
        return text


_SIZES = _Sizes()

_INFALLIBLE_TYPES = {
    "bool",
    *(f"bit:{bit}" for bit in range(16)),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (16, 32, 64)),
    *(f"float{bits}" for bits in (16, 32, 64)),
}
"""Types that decode any registers, to a single JSON number or word."""


class _BlockPart(NamedTuple):
    """The tags of a group that are in one block."""

    decoder: Decoder
    tags: Sequence[ScannedTag]
    ids: Sequence[str]
    templates: Sequence[_Template]
    deadbands: Sequence[float]
    is_plain_json: bool
    """Whether all values can be encoded as one JSON array and split at the commas."""
    needs_cleaning: bool
    """Whether some values must be converted, such as NaN or a marker to `null`."""
    has_profile_tags: bool
    """Whether some tags are from profiles."""
    change: bool
    needs_filter: bool
    """Whether some values may be omitted, or must be remembered."""


_Placed: TypeAlias = tuple[int, _BlockPart]
"""The index of a block, and the part in it."""


class _ScheduledGroup:
    """A group, and when it is due."""

    def __init__(
        self, group: Group, before: _ScheduledGroup | None, *, is_once: bool = False
    ) -> None:
        self.group = group
        self.is_once = is_once
        self.due_time: DueTime = DueTime(
            group.rate / 1000, None if before is None else before.due_time
        )
        self.places = Places(group.tags)
        self.deadbands = {
            tag.id: deadband for tag, deadband in zip(group.tags, group.deadbands, strict=True)
        }
        self.parts: dict[Place, _BlockPart] = {}
        """The compiled parts of blocks, shared by all shapes."""

    def publish_now(self, fresh: Collection[str]) -> Iterable[str]:
        """Makes the group due if all of its tags are fresh. Returns its tags if it is due then."""
        if all(id in fresh for id in self.deadbands):
            self.due_time.make_due()
        return self.deadbands if self.due_time.is_due_at_once else ()

    def keep(self, place: Place, part: _BlockPart) -> None:
        """Caches a part. The cache is limited, because blocks may differ at every poll."""
        if len(self.parts) >= MAX_SHAPES + 2 * len(self.group.tags):
            self.parts.clear()
        self.parts[place] = part
