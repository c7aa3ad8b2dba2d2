"""Byte orders: the arrangement of the bytes of a field on the wire; A is the first byte.

Four letters apply to fields of any size. They combine two choices: the bytes of each register are
swapped (BADC), and the whole field is reversed (DCBA). CDAB is both, so the registers are reversed.
Eight letters describe a field of eight bytes: each letter is the byte of the value at that place on
the wire.

Every order is its own inverse, so the direction (wire or value) does not matter. Eight letters that
are not their own inverse are refused. Registers stay whole: AB, CD, EF and GH move as pairs, and
can be swapped inside.
"""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass
from functools import lru_cache

from holdfast.values.errors import UnknownOrder, shown

LETTERS = "ABCDEFGH"


@dataclass(frozen=True, slots=True)
class Order:
    """The effect of an order: on each register first, then on the field."""

    swapped: bool = False
    """Whether the two bytes of each register are swapped."""
    reversed: bool = False
    """Whether all bytes of the field are reversed."""
    places: tuple[int, ...] = ()
    """The source of each byte, for orders that the other two can't express."""


FOUR = {
    "ABCD": Order(),
    "DCBA": Order(reversed=True),
    "BADC": Order(swapped=True),
    "CDAB": Order(swapped=True, reversed=True),
}
SWAPPED_BYTES = ("BADC", "DCBA")
"""The orders that also swap the bytes of a single register."""
EIGHT = {
    "ABCDEFGH": FOUR["ABCD"],
    "HGFEDCBA": FOUR["DCBA"],
    "BADCFEHG": FOUR["BADC"],
    "GHEFCDAB": FOUR["CDAB"],
}
USUAL_NAMES = {
    **dict.fromkeys(("be", "bebe", "big"), "ABCD"),
    **dict.fromkeys(("bele", "swap", "swapped", "wordswap", "wordswapped"), "CDAB"),
    **dict.fromkeys(("byteswap", "byteswapped", "lebe"), "BADC"),
    **dict.fromkeys(("le", "lele"), "DCBA"),
}
"""What other programs call these orders, to suggest ours: letters only, without `endian`. Words
that programs use for several, such as `mixed` and `little`, are not there."""
DEFAULT_ORDER = "ABCD"
"""The order of a field for which nobody names one."""

ALLOWED = f"{', '.join(FOUR)}, and eight letters such as GHEFCDAB for eight bytes"


@lru_cache(1024)
def order_of(name: str, element: str, width: int) -> Order:
    """The order of a name for elements of `width` bytes. Raises `UnknownOrder`."""
    if name in FOUR:
        return FOUR[name]
    near = _usual(name)
    if near or not isinstance(name, str) or len(name) != 8 or not name.isalpha():
        raise UnknownOrder(f"order {shown(name)} is unknown, allowed: {ALLOWED}{near}")
    flaw = _flaw(name)
    if flaw is not None:
        raise UnknownOrder(f"order {name} {flaw}")
    if width != 8:
        raise UnknownOrder(f"order {name} is for 8 bytes, {element} has {width}")
    return EIGHT.get(name) or Order(places=_places(name))


def _usual(name: object) -> str:
    """A suggestion for a name of other programs, and for small letters, else ""."""
    word = re.sub("endian|[^a-z]", "", str(name).lower())
    meant = USUAL_NAMES.get(word, word.upper())
    return f"; did you mean {meant!r}?" if meant in FOUR else ""


def swap_registers(data: bytes) -> bytes:
    """The bytes of each register swapped."""
    words = array("H", data)
    words.byteswap()
    return words.tobytes()


def move(data: bytes, places: tuple[int, ...]) -> bytes:
    """Moves the bytes of each element; `places` has the source of each byte of an element."""
    moved = bytearray(len(data))
    for place, source in enumerate(places):
        moved[place :: len(places)] = data[source :: len(places)]
    return bytes(moved)


def _places(name: str) -> tuple[int, ...]:
    return tuple(LETTERS.index(letter) for letter in name)


def _flaw(name: str) -> str | None:
    if sorted(name) != list(LETTERS):
        return "is unknown, allowed with eight letters: A to H once each"
    places = _places(name)
    if any(one // 2 != other // 2 for one, other in zip(places[::2], places[1::2], strict=True)):
        return "splits a register, allowed: AB, CD, EF and GH together"
    if any(places[source] != place for place, source in enumerate(places)):
        return "is not its own inverse, allowed: bytes that stay or swap places, as in CDABEFGH"
    return None
