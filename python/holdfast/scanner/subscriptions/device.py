"""The state of a device: its subscribers, its tags and its health. Does no I/O."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.scanner.subscriptions.latest_values import LatestBlocks

if TYPE_CHECKING:
    from collections.abc import Collection

    from holdfast import tags
    from holdfast._core import Endpoint
    from holdfast.client.url import Target
    from holdfast.config.values.scanner_settings import Publish, Writes
    from holdfast.scanner.messages.types import SubscribeRequest
    from holdfast.scanner.subscriptions.health import Health
    from holdfast.scanner.subscriptions.plan import Plan
    from holdfast.scanner.subscriptions.tag import ScannedTag

LOOKUP_INTERVAL_S = 10.0
"""Time between lookups of the name of a device that does not respond."""


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
    profile: str | None = None
    """The profile whose tags it has: all of them, unless a tag that it gained was refused."""
    adopted: tuple[SubscribeRequest, SubscribeRequest] | None = None
    """What it was adopted from in a fleet, and what that has become with the present profile."""


@dataclass(frozen=True, slots=True)
class TagOptions:
    """The properties of a tag that each subscriber sets for itself."""

    writable: bool | None
    """`None` if the request leaves it out."""
    description: str | None

    @staticmethod
    def of_profile(tag: tags.Tag) -> TagOptions:
        """Returns those of a subscriber to a whole profile.

        It declares nothing read-only: the profile does, until it changes.
        """
        return TagOptions(tag.writable or None, tag.description or None)


NO_OPTIONS = TagOptions(None, None)
"""One object for nearly all tags."""


@dataclass(eq=False)
class ScannedDevice:
    """A device with at least one subscriber."""

    id: str
    source: Source
    address: Target
    """The target with the resolved address."""
    health: Health
    writes: Writes = "tags"
    """Which of its tags may be written."""
    endpoint: Endpoint | None = None
    """The native form of `address`, for the poller."""
    subscribers: dict[str, Subscriber] = field(default_factory=dict)
    tags: dict[str, ScannedTag] = field(default_factory=dict)
    """The tags of all subscribers, by id."""
    latest: LatestBlocks = field(default_factory=LatestBlocks)
    undecoded: dict[str, str] = field(default_factory=dict)
    """The errors of tags whose registers were read but can't be decoded."""
    status: bytes = b""
    """The last published state, as JSON."""
    partition: int = 0
    """The partition of a fleet that it belongs to."""
    polled_as: str = ""
    """The device's name in the poller. It gets a new one when it moves to another address."""
    _looked_up: float = field(default_factory=time.monotonic)

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
        options = (each.tags[id] for each in self.subscribers.values() if id in each.tags)
        return next((each.description for each in options if each.description), None)

    def users(self, id: str) -> list[str]:
        """Returns the ids of the subscribers of a tag."""
        return [name for name, each in self.subscribers.items() if id in each.tags]

    def forget(self, ids: Collection[str]) -> list[str]:
        """Removes the given tags that have no subscriber left. Returns the removed ids."""
        used = {id for subscriber in self.subscribers.values() for id in subscriber.tags}
        unused = [id for id in dict.fromkeys(ids) if id in self.tags and id not in used]
        for id in unused:
            del self.tags[id]
        return unused
