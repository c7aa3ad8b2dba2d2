"""The state of a device: its subscribers, its tags and its health. Does no I/O."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast._core import plan_blocks
from holdfast.protocol import READ_BITS, READ_REGISTERS
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.dialects import TENTACLE
from holdfast.scanner.subscriptions.latest import LatestBlocks
from holdfast.scanner.subscriptions.tag import AREA_OF_CODE, Tag

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from holdfast._core import Endpoint
    from holdfast.client.url import Target
    from holdfast.config.scanning import Publish, Writes
    from holdfast.scanner.messages.dialect import Dialect
    from holdfast.scanner.messages.types import PlanRequest, Range
    from holdfast.scanner.subscriptions.health import Health
    from holdfast.types import Area

MAX_GAP = 10

LOOKUP_INTERVAL_S = 10.0
"""Time between lookups of the name of a device that does not respond."""


@dataclass(frozen=True, slots=True)
class Plan:
    """The rules for combining tags into requests."""

    max_gap: int = MAX_GAP
    max_registers: int = READ_REGISTERS
    max_bits: int = READ_BITS
    readable: tuple[tuple[Area, int, int], ...] = ()
    """Area, start and end of ranges; the end is exclusive."""
    forbidden: tuple[tuple[Area, int, int], ...] = ()
    request: PlanRequest | None = field(default=None, compare=False)
    """What this plan was made from."""

    @staticmethod
    def of(request: PlanRequest | None) -> Plan:
        """Creates the plan of a request. Raises `Refused`."""
        if request is None:
            return DEFAULT_PLAN
        return Plan(
            MAX_GAP if request.max_gap is None else request.max_gap,
            request.max_registers or READ_REGISTERS,
            request.max_bits or READ_BITS,
            tuple(_ranges("plan.readable", request.readable or ())),
            tuple(_ranges("plan.forbidden", request.forbidden or ())),
            request,
        )

    def blocks(self, tags: Sequence[Tag]) -> list[tuple[Area, int, int, list[int], int]]:
        """Returns the blocks that read the tags, see `plan_blocks`. Raises `ValueError`."""
        return plan_blocks(
            [(tag.area, tag.span.start, len(tag.span)) for tag in tags],
            max_gap=self.max_gap,
            max_registers=self.max_registers,
            max_bits=self.max_bits,
            readable=self.readable,
            forbidden=self.forbidden,
        )

    def check(self, tags: Sequence[Tag]) -> None:
        """Raises `Refused` for a tag that the plan does not allow to read."""
        for tag in tags:
            most = self.max_bits if tag.of_bits else self.max_registers
            if len(tag.span) > most:
                kind = "bits" if tag.of_bits else "registers"
                scaled = "" if tag.source is None else " with its scale"
                found = f"has {len(tag.span)} {kind}{scaled}, one request reads at most {most}"
                raise Refused(f"tag {tag.id!r}: {tag.type} {found}")
            for area, start, end in self.forbidden:
                if tag.area == area and start < tag.span.stop and tag.span.start < end:
                    found = f"plan.forbidden contains {start} to {end - 1} of {area}"
                    raise Refused(f"tag {tag.id!r} from address {tag.address}: {found}")


DEFAULT_PLAN = Plan()
"""One object for nearly all devices."""


def _ranges(where: str, ranges: Iterable[Range]) -> Iterable[tuple[Area, int, int]]:
    for index, given in enumerate(ranges):
        *area, start, end = given
        addresses = isinstance(start, int) and isinstance(end, int) and start <= end
        if not addresses or any(word not in AREA_OF_CODE for word in area):
            allowed = "allowed: first and last address, with an optional area before them"
            raise Refused(f"{where}[{index}] is {given}, {allowed}")
        assert isinstance(start, int)
        assert isinstance(end, int)
        for code, name in AREA_OF_CODE.items():
            if not area or code in area:
                yield name, start, end + 1


@dataclass(frozen=True, slots=True)
class Source:
    """The address and the settings of a device, common to all of its subscribers."""

    target: Target
    """The target in the request; its host may be a name."""
    unit: int
    timeout: int
    """Milliseconds."""
    release: bool
    plan: Plan
    url: str | None = field(default=None, compare=False)
    """The URL in the request, if it has one."""


@dataclass(slots=True)
class Subscriber:
    """A subscriber of a device: its tags, and how they are published."""

    rate: int
    """Milliseconds."""
    publish: Publish
    deadband: float
    tags: dict[str, TagOptions] = field(default_factory=dict)
    ttl: int | None = None
    """Seconds after which the subscription ends, unless a request renews it."""


@dataclass(frozen=True, slots=True)
class TagOptions:
    """The properties of a tag that each subscriber sets for itself."""

    writable: bool | None
    """`None` if the request leaves it out."""
    description: str | None


NO_OPTIONS = TagOptions(None, None)
"""One object for nearly all tags."""


class ScannedDevice:
    """A device with at least one subscriber."""

    def __init__(
        self,
        id: str,
        source: Source,
        address: Target,
        health: Health,
        writes: Writes = "tags",
        dialect: Dialect = TENTACLE,
    ) -> None:
        self.id = id
        self.subjects = dialect.device_names(id)
        """The names of the device in subjects; nearly always one."""
        self.source = source
        self.address = address
        """The target with the resolved address."""
        self.endpoint: Endpoint | None = None
        """The native form of `address`, for the poller."""
        self.subscribers: dict[str, Subscriber] = {}
        self.tags: dict[str, Tag] = {}
        """The tags of all subscribers, by id."""
        self.health = health
        self.latest = LatestBlocks()
        self.status = b""
        """The last published state, as JSON."""
        self.partition = 0
        """The partition of a fleet that it belongs to."""
        self.polled_as = ""
        """The device's name in the poller. Each change gives it a new one."""
        self._writes = writes
        self._looked_up = time.monotonic()

    @property
    def rate(self) -> int:
        """The scan interval in milliseconds: the shortest of all subscribers."""
        return min(subscriber.rate for subscriber in self.subscribers.values())

    def may_have_moved(self) -> bool:
        """Returns whether its name must be looked up again, at most every `LOOKUP_INTERVAL_S`."""
        now = time.monotonic()
        if self.address == self.source.target or self.health.state != "offline":
            return False
        if now - self._looked_up < LOOKUP_INTERVAL_S:
            return False
        self._looked_up = now
        return True

    def is_extended_by(self, subscriber: str, ids: Collection[str]) -> bool:
        """Returns whether a known subscriber requests only tags that are new."""
        return subscriber in self.subscribers and self.tags.keys().isdisjoint(ids)

    def description(self, id: str) -> str | None:
        """Returns the description of a tag, of the first subscriber that has one."""
        wanted = (each.tags[id] for each in self.subscribers.values() if id in each.tags)
        return next((each.description for each in wanted if each.description), None)

    def users(self, id: str) -> list[str]:
        """Returns the ids of the subscribers of a tag."""
        return [name for name, each in self.subscribers.items() if id in each.tags]

    def unwritable(self, tag: Tag) -> str | None:
        """Returns why a tag can't be written; `None` if it can.

        A subscriber that declares it writable decides, then one that declares it read-only.
        """
        if (flaw := tag.unwritable) is not None:
            return flaw
        if self._writes == "none":
            return "this scanner writes nothing (nats.writes is none)"
        choices = {
            user: self.subscribers[user].tags[tag.id].writable for user in self.users(tag.id)
        }
        if True in choices.values():
            return None
        if self._writes == "explicit":
            return 'no subscriber set "writable": true, which nats.writes: explicit requires'
        return next(
            (f'{user} set "writable": false' for user, each in choices.items() if each is False),
            None,
        )

    def forget(self, ids: Collection[str]) -> list[str]:
        """Removes the given tags that have no subscriber left. Returns the removed ids."""
        wanted = {id for subscriber in self.subscribers.values() for id in subscriber.tags}
        unwanted = [id for id in ids if id in self.tags and id not in wanted]
        for id in unwanted:
            del self.tags[id]
        return unwanted
