"""Parses the target of a command: an area and an address, or a Modicon number."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

from holdfast.protocol import ADDRESSES, LAST_ADDRESS
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.types import Area

SHORT: dict[str, Area] = dict(zip(("co", "di", "hr", "ir"), AREAS, strict=True))
MODICON: dict[str, Area] = dict(zip("0143", AREAS, strict=True))
"""The first digits of Modicon numbers."""

FORMS = "40001, 400001 or 4x0001, and 0, 1, 3 for coils, discrete inputs, input registers"

_MODICON = re.compile(r"([0134])(?:[xX]([0-9]{1,5})|([0-9]{4,5}))")


@dataclass(frozen=True)
class Place:
    """An area, and an address in that area."""

    area: Area
    address: int


def number(text: str) -> int | None:
    """Parses a non-negative integer, decimal or 0x. Returns `None` for other text."""
    if re.fullmatch("0[xX][0-9a-fA-F]{1,20}", text):
        return int(text, 16)
    return int(text) if re.fullmatch("[0-9]{1,20}", text) else None


def area_of(text: str) -> Area:
    """Parses the name of an area, a short form or an unambiguous prefix."""
    name = text.lower().replace("-", "_")
    if name in SHORT:
        return SHORT[name]
    found = [area for area in AREAS if name and area.startswith(name)]
    if len(found) == 1:
        return found[0]
    hint = f"; did you mean {text} --modicon?" if _MODICON.fullmatch(text) else ""
    raise click.UsageError(
        f"{text!r} is not an area, allowed: {', '.join(AREAS)}, co, di, hr, ir{hint or '.'}"
    )


def areas_of(text: str) -> tuple[Area, ...]:
    """Parses a comma-separated list of areas, and returns them in the order of the standard."""
    chosen = {area_of(name.strip()) for name in text.split(",")}
    return tuple(area for area in AREAS if area in chosen)


def taken(words: Sequence[str], *, modicon: bool) -> tuple[Place, list[str]]:
    """Parses a place at the start of the arguments. Returns it and the remaining arguments."""
    left = list(words)
    area = None
    if not modicon or (left and left[0][:1].isalpha()):
        if not left:
            raise click.UsageError("Missing argument 'AREA'.")
        area = area_of(left.pop(0))
    if not left:
        raise click.UsageError("Missing argument 'ADDRESS'.")
    word = left.pop(0)
    if not modicon:
        assert area is not None
        return Place(area, _address(word)), left
    place = _modicon(word)
    if area not in (None, place.area):
        raise click.UsageError(f"{word} is in {place.area}, not in {area}.")
    return place, left


def counted(words: Sequence[str]) -> int:
    """Parses the optional COUNT after a place. Default: 1."""
    if not words:
        return 1
    if len(words) > 1:
        raise click.UsageError(f"Got unexpected extra argument ({' '.join(words[1:])}).")
    count = number(words[0])
    if count is None or not 1 <= count <= ADDRESSES:
        raise click.UsageError(f"COUNT is {words[0]!r}, allowed: 1 to {ADDRESSES}.")
    return count


def modicon_hint(place: Place) -> str | None:
    """A hint for an address that does not exist but looks like a Modicon number."""
    match = _MODICON.fullmatch(str(place.address))
    if match is None or MODICON[match[1]] != place.area:
        return None
    meant = int(match[3]) - 1
    if meant < 0:
        return None
    return f"addresses count from 0; as a Modicon number (--modicon) {place.address} is {meant}"


def complete(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes areas in a shell."""
    return [CompletionItem(area) for area in AREAS if area.startswith(incomplete)]


def _address(text: str) -> int:
    address = number(text)
    if address is None or address > LAST_ADDRESS:
        hint = f"; did you mean {text} --modicon?" if _MODICON.fullmatch(text) else "."
        raise click.UsageError(
            f"ADDRESS is {text!r}, allowed: 0 to {LAST_ADDRESS}, decimal or 0x{hint}"
        )
    return address


def _modicon(text: str) -> Place:
    match = _MODICON.fullmatch(text)
    count = int(match[2] or match[3]) if match else 0
    if match is None or not 1 <= count <= ADDRESSES:
        raise click.UsageError(f"{text!r} is not a Modicon number, as in {FORMS}.")
    return Place(MODICON[match[1]], count - 1)
