"""Which tags are published how often: what all subscribers of a device want, put together. Pure.

All subscribers of a device listen to one subject, so a tag is published as often as the fastest of
those who want it asks. Where one wants every value and another wants changes sooner than that, it
is published for both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.scanner.devices import ScannedDevice
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


def grouped(device: ScannedDevice) -> list[Group]:
    """The groups of a device: those that are always published first, then by rate."""
    demands: dict[tuple[bool, int, float], set[str]] = {}
    for subscriber in device.subscribers.values():
        demand = (subscriber.publish == "change", subscriber.rate, subscriber.deadband)
        demands.setdefault(demand, set()).update(subscriber.tags)
    members: dict[tuple[bool, int], dict[str, float]] = {}
    for (change, rate, deadband), ids in _needed(demands):
        members.setdefault((change, rate), {}).update(dict.fromkeys(ids, deadband))
    groups = []
    for (change, rate), deadbands in sorted(members.items()):
        tags = tuple(tag for id, tag in device.tags.items() if id in deadbands)
        groups.append(Group(rate, change, tags, tuple(deadbands[tag.id] for tag in tags)))
    return groups


def _needed(
    demands: Mapping[tuple[bool, int, float], set[str]],
) -> Iterator[tuple[tuple[bool, int, float], list[str]]]:
    """The demands with those of their tags for which no other demand includes them."""
    scanned: dict[str, int] = {}
    """The rate at which a tag is always published."""
    narrowest: dict[str, float] = {}
    """The least deadband that was asked for, at this rate or sooner."""
    for (change, rate, deadband), ids in sorted(demands.items()):
        if change:
            needed = [
                id
                for id in ids
                if scanned.get(id, math.inf) > rate and narrowest.get(id, math.inf) > deadband
            ]
            narrowest.update(dict.fromkeys(needed, deadband))
        else:
            needed = [id for id in ids if id not in scanned]
            scanned.update(dict.fromkeys(needed, rate))
        if needed:
            yield (change, rate, deadband), needed
