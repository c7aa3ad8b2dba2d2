"""Byte orders: how the bytes of a field, A first, are arranged on the wire.

Four letters follow the field, whatever its size. They are two choices: the bytes of each register
swapped (BADC), and the whole field reversed (DCBA); CDAB is both, which leaves the registers
reversed. Eight letters spell a field of eight bytes out: the letter at a place of the wire names
the byte of the value.

An order applied twice changes nothing. Hence eight letters that are not their own inverse are no
order; with the others it does not matter whether they are read from the wire or from the value.
Registers stay whole too: AB, CD, EF and GH are moved as pairs, and may be swapped inside.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from functools import lru_cache

from holdfast.values.errors import UnknownOrder, shown

LETTERS = "ABCDEFGH"


@dataclass(frozen=True, slots=True)
class Order:
    """What an order does: to each register first, then to the field."""

    swapped: bool = False
    """The two bytes of each register change places."""
    reversed: bool = False
    """All bytes of the field are reversed."""
    places: tuple[int, ...] = ()
    """Where each byte comes from, if the other two can't say it."""


FOUR = {
    "ABCD": Order(),
    "DCBA": Order(reversed=True),
    "BADC": Order(swapped=True),
    "CDAB": Order(swapped=True, reversed=True),
}
EIGHT = {
    "ABCDEFGH": FOUR["ABCD"],
    "HGFEDCBA": FOUR["DCBA"],
    "BADCFEHG": FOUR["BADC"],
    "GHEFCDAB": FOUR["CDAB"],
}
ALLOWED = f"{', '.join(FOUR)}, and eight letters such as GHEFCDAB for eight bytes"


@lru_cache(1024)
def order_of(name: str, element: str, width: int) -> Order:
    """The order of a name for elements of `width` bytes. Raises `UnknownOrder`."""
    if name in FOUR:
        return FOUR[name]
    if not isinstance(name, str) or len(name) != 8 or not name.isalpha():
        raise UnknownOrder(f"order {shown(name)} is unknown, allowed are {ALLOWED}")
    flaw = _flaw(name)
    if flaw is not None:
        raise UnknownOrder(f"order {name} {flaw}")
    if width != 8:
        raise UnknownOrder(f"order {name} is for 8 bytes, {element} has {width}")
    return EIGHT.get(name) or Order(places=_places(name))


def swap_registers(data: bytes) -> bytes:
    """The bytes of each register swapped."""
    words = array("H", data)
    words.byteswap()
    return words.tobytes()


def move(data: bytes, places: tuple[int, ...]) -> bytes:
    """The bytes of each element moved; `places` say where each byte of an element comes from."""
    moved = bytearray(len(data))
    for place, source in enumerate(places):
        moved[place :: len(places)] = data[source :: len(places)]
    return bytes(moved)


def _places(name: str) -> tuple[int, ...]:
    return tuple(LETTERS.index(letter) for letter in name)


def _flaw(name: str) -> str | None:
    if sorted(name) != list(LETTERS):
        return "is unknown, eight letters are A to H once each"
    places = _places(name)
    if any(places[at] // 2 != places[at + 1] // 2 for at in range(0, 8, 2)):
        return "splits a register, allowed is to keep AB, CD, EF and GH together"
    if any(places[source] != place for place, source in enumerate(places)):
        return "is not undone by applying it again"
    return None
