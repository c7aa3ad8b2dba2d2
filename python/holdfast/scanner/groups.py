"""Which tags are published how often: what all subscribers of a device want, put together. Pure.

All subscribers of a device listen to one subject, so a tag is published as often as the fastest of
those who want it asks. Where one wants every value and another wants changes sooner than that, it
is published for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.scanner.devices import Device
    from holdfast.scanner.tags import Tag


@dataclass(frozen=True)
class Group:
    """Tags that are published alike."""

    rate: int
    """Milliseconds."""
    change: bool
    """Only those that changed by more than their deadbands."""
    tags: tuple[Tag, ...]
    deadbands: tuple[float, ...]


def grouped(device: Device) -> list[Group]:
    """The groups of a device: those that are always published first, then by rate."""
    members: dict[tuple[bool, int], dict[str, float]] = {}
    for id in device.tags:
        demands = (
            (subscriber.publish == "change", subscriber.rate, subscriber.deadband)
            for subscriber in device.subscribers.values()
            if id in subscriber.tags
        )
        for change, rate, deadband in _needed(demands):
            members.setdefault((change, rate), {})[id] = deadband
    return [
        Group(rate, change, tuple(device.tags[id] for id in ids), tuple(ids.values()))
        for (change, rate), ids in sorted(members.items())
    ]


def _needed(demands: Iterable[tuple[bool, int, float]]) -> list[tuple[bool, int, float]]:
    """The demands of one tag without those that others include."""
    needed: list[tuple[bool, int, float]] = []
    for demand in sorted(set(demands)):
        change, rate, deadband = demand
        included = any(
            other_rate <= rate and (not other_change or (change and other_deadband <= deadband))
            for other_change, other_rate, other_deadband in needed
        )
        if not included:
            needed.append(demand)
    return needed
