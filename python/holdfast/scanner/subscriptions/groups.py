"""Combines the subscriptions of a device into groups of tags with one publishing rate. Does no I/O.

All subscribers of a device share one subject, so a tag is published at the rate of its fastest
subscriber. A tag is in two groups if one subscriber requests every value, and another requests
changes at a faster rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import ScannedTag


@dataclass(frozen=True)
class Group:
    """Tags with the same rate and mode of publishing."""

    rate: int
    """Milliseconds."""
    change: bool
    """Whether only changes greater than the deadbands are published."""
    tags: tuple[ScannedTag, ...]
    deadbands: tuple[float, ...]


def grouped(device: ScannedDevice) -> list[Group]:
    """Returns the groups of a device: first those that publish every value, then by rate."""
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
    """Yields each demand with those of its tags that no other demand already covers."""
    scanned: dict[str, int] = {}
    """The rate at which every value of a tag is published."""
    narrowest: dict[str, float] = {}
    """The smallest deadband of a tag so far, at this rate or faster."""
    # Sorted: first those for every value, then by rate, then by deadband. So each demand needs to
    # look only at the demands before it.
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
