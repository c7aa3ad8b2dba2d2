"""What is known of a device: who wants what of it, and how it does. Nothing here does I/O."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast._core import plan_blocks
from holdfast.protocol import READ_BITS, READ_REGISTERS
from holdfast.scanner.errors import Refused
from holdfast.scanner.tags import AREA_OF_CODE, Tag

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from holdfast._core import Endpoint
    from holdfast.client.target import Target
    from holdfast.scanner.health import Health
    from holdfast.scanner.messages import PlanRequest, Publish, Range
    from holdfast.types import Area

MAX_GAP = 10

LOOK_UP = 10.0
"""Seconds after which the name of a device that does not answer is looked up again."""


@dataclass(frozen=True)
class Plan:
    """The rules that blocks are drawn by."""

    max_gap: int = MAX_GAP
    max_registers: int = READ_REGISTERS
    max_bits: int = READ_BITS
    readable: tuple[tuple[Area, int, int], ...] = ()
    """Areas with start and end, the end not included."""
    forbidden: tuple[tuple[Area, int, int], ...] = ()

    @staticmethod
    def of(request: PlanRequest | None) -> Plan:
        """The rules that a request names. Raises `Refused`."""
        if request is None:
            return Plan()
        return Plan(
            MAX_GAP if request.max_gap is None else request.max_gap,
            request.max_registers or READ_REGISTERS,
            request.max_bits or READ_BITS,
            tuple(_ranges("plan.readable", request.readable or ())),
            tuple(_ranges("plan.forbidden", request.forbidden or ())),
        )

    def blocks(self, tags: Sequence[Tag]) -> list[tuple[Area, int, int, list[int], int]]:
        """The requests that read tags, as `plan_blocks` has them. Raises `ValueError`."""
        return plan_blocks(
            [(tag.area, tag.address, tag.count) for tag in tags],
            max_gap=self.max_gap,
            max_registers=self.max_registers,
            max_bits=self.max_bits,
            readable=self.readable,
            forbidden=self.forbidden,
        )

    def check(self, tags: Sequence[Tag]) -> None:
        """Raises `Refused` for a tag that no request may read."""
        for tag in tags:
            most = self.max_bits if tag.of_bits else self.max_registers
            if tag.count > most:
                kind = "bits" if tag.of_bits else "registers"
                found = f"takes {tag.count} {kind}, one request reads at most {most}"
                raise Refused(f"tag {tag.id!r}: {tag.type} {found}")
            for area, start, end in self.forbidden:
                if tag.area == area and start < tag.end and tag.address < end:
                    found = f"plan.forbidden has {start} to {end - 1} of {area}"
                    raise Refused(f"tag {tag.id!r} from address {tag.address} on: {found}")


def _ranges(where: str, ranges: Iterable[Range]) -> Iterable[tuple[Area, int, int]]:
    for index, given in enumerate(ranges):
        *area, start, end = given
        addresses = isinstance(start, int) and isinstance(end, int) and start <= end
        if not addresses or any(word not in AREA_OF_CODE for word in area):
            allowed = "allowed are first and last address, an area may stand before them"
            raise Refused(f"{where}[{index}] is {given}, {allowed}")
        assert isinstance(start, int)
        assert isinstance(end, int)
        for code, name in AREA_OF_CODE.items():
            if not area or code in area:
                yield name, start, end + 1


@dataclass(frozen=True)
class Source:
    """Where a device is and how it is talked to; the same for all of its subscribers."""

    target: Target
    """As it was asked for."""
    unit: int
    timeout: int
    """Milliseconds."""
    release: bool
    plan: Plan


@dataclass
class Subscriber:
    """Somebody who wants tags of a device, and how often."""

    rate: int
    """Milliseconds."""
    publish: Publish
    deadband: float
    tags: dict[str, Wanted] = field(default_factory=dict)


@dataclass(frozen=True)
class Wanted:
    """What a subscriber says of a tag beside what it is."""

    writable: bool
    description: str | None


class ScannedDevice:
    """A device that somebody wants tags of."""

    def __init__(self, id: str, source: Source, address: Target, health: Health) -> None:
        self.id = id
        self.source = source
        self.address = address
        """The target that is connected to: an address where `source` may have a name."""
        self.endpoint: Endpoint | None = None
        """The same as the poller has it."""
        self.subscribers: dict[str, Subscriber] = {}
        self.tags: dict[str, Tag] = {}
        """What the subscribers want, all together, by id."""
        self.health = health
        self.polled_as = ""
        """The name that the poller knows it by, which is new with every change."""
        self._looked_up = time.monotonic()

    @property
    def rate(self) -> int:
        """Milliseconds from scan to scan: those of the fastest subscriber."""
        return min(subscriber.rate for subscriber in self.subscribers.values())

    def may_have_moved(self) -> bool:
        """Whether it is time to look up its name again, which is noted then."""
        now = time.monotonic()
        if self.address == self.source.target or self.health.state != "offline":
            return False
        if now - self._looked_up < LOOK_UP:
            return False
        self._looked_up = now
        return True

    def is_extended_by(self, subscriber: str, ids: Collection[str]) -> bool:
        """Whether a subscriber that is known asks for tags beside those that there are."""
        return subscriber in self.subscribers and self.tags.keys().isdisjoint(ids)

    def writable(self, id: str) -> bool:
        """Whether one of the subscribers of a tag says so."""
        return any(
            id in subscriber.tags and subscriber.tags[id].writable
            for subscriber in self.subscribers.values()
        )

    def forget(self, ids: Collection[str]) -> list[str]:
        """Drops those of some tags that nobody wants any more; which they were."""
        wanted = {id for subscriber in self.subscribers.values() for id in subscriber.tags}
        unwanted = [id for id in ids if id in self.tags and id not in wanted]
        for id in unwanted:
            del self.tags[id]
        return unwanted
