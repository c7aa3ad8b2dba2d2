"""Items, as commands take them: `hr:0`, `hr 0`, `40001`, `4x0001`, `%MW0`, `hr:0:float32:CDAB`.

An address beside an area counts from 0, as in requests. Modicon numbers count from 1 and name the
area themselves. A spelling with two readings is refused, and the error names both.
"""

from __future__ import annotations

import re
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

from holdfast.cli.options.option import Command, whole_number
from holdfast.cli.options.plc_addresses import (
    MODICON_NUMBER,
    Place,
    of_modicon,
    of_number,
    suggested_bit,
)
from holdfast.protocol import ADDRESSES, LAST_ADDRESS
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing
from holdfast.types import AREAS, SHORT_AREAS, SHORT_OF

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.types import Area

SIZED = ("bit", "string", "bytes")
"""Types whose name has a colon."""

FORM = "AREA:ADDRESS[:TYPE[:ORDER]], as in hr:100:float32:CDAB"
RANGE = "[ITEM [COUNT]]"
ITEMS = "[ITEM [COUNT] | ITEM...]"


@dataclass(frozen=True)
class Item:
    """An item of the command line."""

    text: str
    place: Place
    count: int | None
    """The number of addresses of FIRST-LAST."""
    type: str | None
    order: str


def span(text: str, last: int = LAST_ADDRESS) -> range | None:
    """Parses FIRST-LAST or a single number, up to `last`. Returns `None` for other text."""
    first, dash, end = text.strip().partition("-")
    numbers = whole_number(first), whole_number(end if dash else first)
    if numbers[0] is None or numbers[1] is None or not numbers[0] <= numbers[1] <= last:
        return None
    return range(numbers[0], numbers[1] + 1)


def area_of(text: str) -> Area:
    """Parses the name of an area, a short form or an unambiguous prefix, in any case."""
    area = _area_named(text)
    if area is not None:
        return area
    known = (*AREAS, *SHORT_AREAS)
    near = _with_colon(text) or suggestion(text.lower().replace("-", "_"), known)
    raise click.UsageError(f"{text!r} is not an area, allowed: {listing(known)}{near}")


def _area_named(text: str) -> Area | None:
    if re.fullmatch("[A-Za-z_ -]+", text) is None:
        return None
    name = re.sub("[_ -]", "", text.lower())
    if name in SHORT_AREAS:
        return SHORT_AREAS[name]
    found = [area for area in AREAS if name and area.replace("_", "").startswith(name)]
    return found[0] if len(found) == 1 else None


def _with_colon(text: str) -> str:
    """A suggestion for `hr100` and `co.1`, else ""."""
    match = re.fullmatch("(.*[A-Za-z])[^A-Za-z0-9]?([0-9]+)", text)
    if match is None or _area_named(match[1]) is None or MODICON_NUMBER.fullmatch(match[2]):
        return ""  # `hr40001` may mean the address 40001, or 0.
    return f"; did you mean '{match[1]}:{match[2]}', counted from 0?"


def areas_of(text: str) -> tuple[Area, ...]:
    """Parses a comma-separated list of areas, and returns them in the order of the standard."""
    chosen = {area_of(name.strip()) for name in text.split(",")}
    return tuple(area for area in AREAS if area in chosen)


def range_of(text: str) -> tuple[Area, int, int]:
    """Parses AREA:FIRST-LAST. Returns the area, the first address, and the one after the last."""
    area, _, addresses = text.partition(":")
    found = span(addresses)
    if found is None:
        raise click.BadParameter(
            f"{text!r} is not AREA:FIRST-LAST, as in hr:100-119, up to {LAST_ADDRESS}."
        )
    return area_of(area), found.start, found.stop


def take(words: Sequence[str]) -> tuple[Item, list[str]]:
    """Parses the item at the start of the arguments. Returns it and the remaining arguments."""
    left = list(words)
    if not left:
        raise click.UsageError("Missing argument 'AREA'.")
    text = left.pop(0)
    head, *parts = text.split(":")
    place, count = of_number(head), None
    if place is None:
        area = area_of(head)
        if not parts:
            if not left:
                raise click.UsageError("Missing argument 'ADDRESS'.")
            parts = left.pop(0).split(":")
            text = f"{text}:{':'.join(parts)}"
        place, count = _addressed(parts.pop(0), area)
    kind = parts.pop(0).lower() if parts else None
    if kind in SIZED and parts:
        kind = f"{kind}:{parts.pop(0)}"
    order = parts.pop(0).upper() if parts else "ABCD"
    if parts or text.endswith(":") or (count is not None and kind is not None):
        raise click.UsageError(f"{text!r} is not {FORM}.")
    return Item(text, place, count, kind, order), left


def take_range(words: Sequence[str]) -> tuple[Item, int | None]:
    """Parses an item and an optional COUNT after it, which is all that may be there."""
    item, left = take(words)
    if item.count is not None and left:
        raise click.UsageError(f"{item.text!r} and COUNT: give only one.")
    if len(left) > 1:
        raise click.UsageError(f"Got unexpected extra argument ({' '.join(left[1:])}).")
    count = item.count
    if left:
        count = whole_number(left[0])
        if count is None or not 1 <= count <= ADDRESSES:
            raise click.UsageError(f"COUNT is {left[0]!r}, allowed: 1 to {ADDRESSES}.")
    return item, count


def single(words: Sequence[str]) -> tuple[Place, int | None]:
    """Parses an item without a type, and the number of its addresses, if it is named."""
    item, count = take_range(words)
    if item.type is not None:
        raise click.UsageError(f"{item.text!r}: a type can't be used here.")
    place = item.place
    if place.address + (count or 1) > ADDRESSES:
        raise click.UsageError(
            f"{count} from address {place.address}: the last address is {LAST_ADDRESS}."
        )
    return place, count


def are_several(words: Sequence[str]) -> bool:
    """Whether arguments are items with names of their own, not one item and its COUNT."""
    if not words:
        return False
    item, left = take(words)
    if not left:
        return ":" in words[0] and item.count is None
    count = whole_number(left[0])
    if count is None:
        # `hr 0 x` has a wrong COUNT, `hr 0 hr 4` and `hr 0 4x0003` have another item.
        return (
            ":" in words[0]
            or re.match("%|[134][xX]|[^:]+:", left[0]) is not None
            or (len(left) > 1 and left[0].isalpha())
        )
    has_own_area = ":" in words[0] or not words[0][:1].isalpha()
    match = MODICON_NUMBER.fullmatch(left[0])
    if has_own_area and match is not None:
        meant, (area, first) = of_modicon(left[0]), astuple(item.place)
        raise click.UsageError(
            f"{left[0]!r} is not clear: type {SHORT_OF[area]}:{first}-{first + count - 1} for that "
            f"many, or {SHORT_OF[meant.area]}:{meant.address} for the Modicon number."
        )
    return False


def complete(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes areas in a shell."""
    return [CompletionItem(area) for area in AREAS if area.startswith(incomplete)]


def words_argument(metavar: str, *, required: bool = False) -> Callable[[Command], Command]:
    """Adds the words after a URL, which begin with an item."""
    return click.argument(
        "words", nargs=-1, required=required, metavar=metavar, shell_complete=complete
    )


def _addressed(text: str, area: Area) -> tuple[Place, int | None]:
    """The place of an address beside its area, and the number of addresses of FIRST-LAST."""
    if re.fullmatch("[134][xX][0-9]+", text):
        place = of_modicon(text)
        if place.area != area:
            raise click.UsageError(f"{text} is in {place.area}, not in {area}.")
        return place, None
    found = span(text)
    if found is None:
        near = suggested_bit(text, area)
        if MODICON_NUMBER.fullmatch(text):
            meant = of_modicon(text)
            near = f"; did you mean {SHORT_OF[meant.area]}:{meant.address}, Modicon's {text}?"
        first, _, last = text.partition("-")
        if None not in (span(first), span(last)):
            near = f"; in FIRST-LAST, the lower address is first: {last}-{first}"
        allowed = f"allowed: 0 to {LAST_ADDRESS}, decimal or 0x{near}"
        raise click.UsageError(f"ADDRESS is {text!r}, {allowed}")
    return Place(area, found.start), len(found) if "-" in text else None
