"""The option `--units`: several unit ids."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from holdfast.cli import places
from holdfast.protocol import MAX_UNIT

if TYPE_CHECKING:
    from collections.abc import Iterable


def unit_ids(text: str) -> tuple[int, ...]:
    """Parses unit ids and ranges of them, as in `1-10,255`, in this order, each once."""
    found: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        least, most = places.number(first), places.number(last if dash else first)
        if least is None or most is None or not least <= most <= MAX_UNIT:
            raise click.BadParameter(
                f"{part.strip()!r} is not a unit id or FIRST-LAST, as in 1-10,255, up to "
                f"{MAX_UNIT}."
            )
        found.update(dict.fromkeys(range(least, most + 1)))
    return tuple(found)


def listed(units: Iterable[int]) -> str:
    """Unit ids as text: `1-10, 255`."""
    ranges: list[list[int]] = []
    for unit in sorted(units):
        if ranges and unit == ranges[-1][1] + 1:
            ranges[-1][1] = unit
        else:
            ranges.append([unit, unit])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in ranges) or "none"
