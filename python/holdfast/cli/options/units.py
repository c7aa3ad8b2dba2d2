"""The option `--units`: several unit ids."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from holdfast.cli.options import item
from holdfast.protocol import MAX_UNIT

if TYPE_CHECKING:
    from collections.abc import Sequence


def refuse_broadcast(units: Sequence[int]) -> None:
    """Raises `click.UsageError` for unit id 0, which no device on a serial line answers."""
    if 0 in units:
        raise click.UsageError("Unit id 0 is the broadcast on a serial line: nobody answers it.")


def unit_ids(text: str) -> tuple[int, ...]:
    """Parses unit ids and ranges of them, as in `1-10,255`, in this order, each once."""
    found: dict[int, None] = {}
    for part in text.split(","):
        units = item.span(part, MAX_UNIT)
        if units is None:
            raise click.BadParameter(
                f"{part.strip()!r} is not a unit id or FIRST-LAST, as in 1-10,255, up to "
                f"{MAX_UNIT}."
            )
        found.update(dict.fromkeys(units))
    return tuple(found)
