"""Addresses as the programs of controllers write them: Modicon, and IEC 61131-3.

Modicon numbers (`40001`, `4x0001`) count from 1, and their first digit names the area.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from holdfast.cli.options.option import whole_number
from holdfast.protocol import ADDRESSES, LAST_ADDRESS
from holdfast.types import AREAS, BIT_AREAS, SHORT_OF

if TYPE_CHECKING:
    from holdfast.tags import Tag
    from holdfast.types import Area

MODICON_AREAS: dict[str, Area] = dict(zip("0143", AREAS, strict=True))
"""The first digits of Modicon numbers."""

MODICON_FORMS = "40001, 400001 or 4x0001, and 0, 1, 3 for coils, discrete inputs, input registers"
_BIT = re.compile(r"(.+)[.]0*([0-9]|1[0-5])")
MODICON_NUMBER = re.compile(r"([0134])(?:([xX])([0-9]{1,5})|([0-9]{4,5}))")

_IEC = re.compile(r"%([A-Z]+)([0-9]{1,5})(.*)", re.I)
IEC_AREAS: dict[str, Area] = {"M": "coils", "MW": "holding_registers"}
IEC_READINGS = {
    "MD": "hr:{0}:uint32 or hr:{1}:uint32, as controllers count words or pairs of words",
    "MF": "hr:{0}:float32 or hr:{1}:float32, as controllers count words or pairs of words",
    "IW": "ir:{0} or, with CODESYS, hr:{0}",
    "QW": "hr:{0} or, with CODESYS, ir:{0}",
    "MX": "co:{0}, or a bit of a register, as in hr:0:bit:3",
}
"""What addresses of IEC 61131-3 may mean that controllers use in several ways."""


@dataclass(frozen=True)
class Place:
    """An area, and an address in that area."""

    area: Area
    address: int


def of_number(text: str) -> Place | None:
    """The place of a number that names its area: Modicon's, or IEC's. `None` for other text."""
    if text.startswith("%"):
        return of_iec(text)
    match = MODICON_NUMBER.fullmatch(text)
    if match is not None and text[:2] in ("0x", "0X"):
        meant = of_modicon(text).address
        raise click.UsageError(
            f"{text!r} is not clear: type co:{meant} for the Modicon number, or name the area of "
            f"the address {int(text, 16)}, as in hr:{text}."
        )
    if near := suggested_bit(text):
        raise click.UsageError(f"{text!r} is not an item{near}")
    if match is not None:
        return of_modicon(text)
    if whole_number(text) is not None:
        raise click.UsageError(
            f"{text!r} has no area: type hr:{text} for a holding register, counted from 0, or "
            "co, di, ir instead of hr."
        )
    return None


def of_modicon(text: str) -> Place:
    """Parses a Modicon number."""
    match = MODICON_NUMBER.fullmatch(text)
    count = int(match[3] or match[4]) if match else 0
    if match is None or not 1 <= count <= ADDRESSES:
        raise click.UsageError(f"{text!r} is not a Modicon number, as in {MODICON_FORMS}.")
    return Place(MODICON_AREAS[match[1]], count - 1)


def suggested_bit(text: str, area: Area | None = None) -> str:
    """A suggestion for an address with a bit, as `40101.3` in other programs, else "".

    `area` is that of a number beside it.
    """
    match = _BIT.fullmatch(text)
    if match is None:
        return ""
    if area is not None:
        place = f"{SHORT_OF[area]}:{match[1]}" if whole_number(match[1]) is not None else ""
    else:
        number = MODICON_NUMBER.fullmatch(match[1])
        area, place = (MODICON_AREAS[number[1]], match[1]) if number else (None, "")
    if not place or area in BIT_AREAS:
        return ""
    return f"; did you mean '{place}:bit:{match[2]}'?"


def modicon_hint(place: Place | Tag) -> str | None:
    """A hint for an address that does not exist but looks like a Modicon number."""
    match = MODICON_NUMBER.fullmatch(str(place.address))
    if match is None or MODICON_AREAS[match[1]] != place.area:
        return None
    meant = int(match[4]) - 1
    if meant < 0:
        return None
    found = f"{SHORT_OF[place.area]}:{meant}"
    return f"addresses count from 0; as a Modicon number {place.address} is {found}"


def of_iec(text: str) -> Place:
    """Parses an address of IEC 61131-3 with a single meaning."""
    match = _IEC.fullmatch(text)
    kind, address = (match[1].upper(), int(match[2])) if match else ("", 0)
    if kind in IEC_READINGS:
        readings = IEC_READINGS[kind].format(address, 2 * address)
        one, _, other = readings.partition(" or ")
        if other.startswith(f"{one},"):  # Words and pairs of words both begin with 0.
            raise click.UsageError(f"{text!r} is not an item: type {one}.")
        raise click.UsageError(f"{text!r} is not clear: type {readings}.")
    if match is None or match[3] or kind not in IEC_AREAS or address > LAST_ADDRESS:
        raise click.UsageError(
            f"{text!r} is not an item, allowed: %MW0 for hr:0, %M0 for co:0, up to {LAST_ADDRESS}."
        )
    return Place(IEC_AREAS[kind], address)
