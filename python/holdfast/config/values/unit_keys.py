"""Keys of `units`: a unit id, or a range of unit ids as in 20-40."""

from __future__ import annotations

import re
from typing import TypeAlias

UnitKey: TypeAlias = int | str
"""A unit id, or the text of a range."""

EXAMPLE = "20-40"

_RANGE = re.compile("([0-9]{1,3})-([0-9]{1,3})", re.ASCII)


def parse_unit_key(value: object, least: int, most: int) -> UnitKey | None:
    """The key; `None` if it is not valid, or not from `least` to `most`."""
    if type(value) is int:
        return value if least <= value <= most else None
    if not isinstance(value, str) or _RANGE.fullmatch(value) is None:
        return None
    ids = unit_ids(value)
    return value if ids and least <= ids[0] and ids[-1] <= most else None


def unit_ids(key: UnitKey) -> range:
    """The unit ids of a valid key."""
    if isinstance(key, int):
        return range(key, key + 1)
    first, _, last = key.partition("-")
    return range(int(first), int(last) + 1)
