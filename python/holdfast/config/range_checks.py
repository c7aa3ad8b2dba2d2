"""Checks ranges of addresses: start and end, or start and count."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.lenient import entries, integer
from holdfast.protocol import ADDRESSES, LAST_ADDRESS

if TYPE_CHECKING:
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


def check_ranges(
    path: KeyPath, ranges: object, report: Report
) -> list[tuple[KeyPath, object, range]]:
    """Reports what is wrong. Returns the valid ranges, each with its path and its area."""
    found = []
    for index, each in enumerate(entries(ranges)):
        if not isinstance(each, dict):
            continue
        here = (*path, index)
        if "end" in each and "count" in each:
            message = "found together with end, allowed: only one of them"
            report.add((*here, "count"), message, of_key=True)
        elif not each.keys() & {"end", "count"}:
            message = "found neither end nor count, allowed: one of them"
            report.add(here, message, of_key=True)
        else:
            span = _range(here, each, report)
            if span is not None:
                found.append((here, each.get("area"), span))
    return found


def _range(path: KeyPath, each: dict[Any, Any], report: Report) -> range | None:
    start = integer(each.get("start"), 0, LAST_ADDRESS)
    if "count" in each:
        return counted(path, start, each["count"], "start", report)
    end = integer(each["end"], 0, LAST_ADDRESS)
    if start is None or end is None:
        return None
    if end < start:
        message = f"found {end}, allowed: the last address, {start} or more"
        report.add((*path, "end"), message)
        return None
    return range(start, end + 1)


def counted(
    path: KeyPath, first: int | None, count: object, key: str, report: Report
) -> range | None:
    """The `count` addresses from `first` on, `None` if they are not valid."""
    number = integer(count, 1, ADDRESSES)
    if first is None or number is None:
        return None
    if first + number > ADDRESSES:
        message = f"found {key} {first} and count {number}, allowed: a sum up to {ADDRESSES}"
        report.add((*path, "count"), message)
        return None
    return range(first, first + number)
