"""Which requests read an imported device: none reads more than those of the source did.

A longer one, or an address that the source never read, may be answered with exception 04 or not
at all, and then none of its values is read.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.protocol import ADDRESSES, READ_BITS, READ_REGISTERS
from holdfast.types import AREAS, BIT_AREAS, REGISTER_AREAS, Area
from holdfast.values import register_count

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

Request: TypeAlias = tuple[Area, range]
"""What one request of the source reads."""

_LIMITS = {
    "max_registers": (READ_REGISTERS, REGISTER_AREAS),
    "max_bits": (READ_BITS, BIT_AREAS),
}


def read_settings(
    requests: Collection[Request], tags: Collection[Mapping[str, Any]]
) -> dict[str, int]:
    """The settings of a device whose tags are in these requests.

    A gap between tags is read if one of them read it, unless that joins others that contain an
    address that none read. Requests that follow each other would be joined: the largest is the
    limit.
    """
    inside, between = [0], [ADDRESSES]
    stretches: list[Request] = []
    for area in AREAS:
        ranges = [each for of, each in requests if of == area]
        read = joined(ranges)
        stretches += [(area, each) for each in read]
        for gap in _gaps(_addresses(tag) for tag in tags if tag["area"] == area):
            if _has(ranges, gap):
                inside.append(len(gap))
            elif not _has(read, gap):
                between.append(len(gap))
    settings = {"max_gap": min(max(inside), min(between) - 1)}
    for key, (most, areas) in _LIMITS.items():
        largest, longest = (
            max((len(each) for area, each in found if area in areas), default=0)
            for found in (requests, stretches)
        )
        if largest < min(longest, most):
            settings[key] = largest
    return settings


def joined(ranges: Iterable[range], max_gap: int = 0) -> list[range]:
    """The ranges, as one if they overlap or the gap between them is at most this large."""
    found: list[range] = []
    for each in sorted(ranges, key=lambda each: each.start):
        if found and each.start <= found[-1].stop + max_gap:
            found[-1] = range(found[-1].start, max(found[-1].stop, each.stop))
        else:
            found.append(each)
    return found


def _gaps(ranges: Iterable[range]) -> list[range]:
    return [range(before.stop, after.start) for before, after in pairwise(joined(ranges))]


def _has(ranges: Iterable[range], gap: range) -> bool:
    """Whether one of the ranges contains a whole gap."""
    return any(each.start <= gap.start and gap.stop <= each.stop for each in ranges)


def _addresses(tag: Mapping[str, Any]) -> range:
    return range(tag["address"], tag["address"] + register_count(tag.get("type", "bool")))
