"""Function codes: from the source's lists to the keys of a rule of ours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.words import listing, show
from holdfast.protocol import CODES, FUNCTIONS, WRITING_CODES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.importing.sections import Section

SOURCE = frozenset({1, 2, 3, 4, 5, 6, 15, 16})
"""What the source serves; the others it always refused."""

ALL = frozenset(CODES)
WRITING = frozenset(WRITING_CODES)
READING = ALL - WRITING
WRITING_ONLY = SOURCE & WRITING
"""Functions that write and read nothing: without 23, and without 22, whose result tells bits."""

OTHERS = frozenset(each.code for each in FUNCTIONS if each.area is None)
"""Functions that read or write no area."""

_CLOSE = {22: {6, 16}, 23: {3, 6, 16}}
"""Functions that do what others do: who is denied those must not get these."""


def read_codes(section: Section, key: str) -> list[int] | None:
    """The codes of a list that we know, each once; `None` when there is no list."""
    entries = section.entries(key)
    if entries is None:
        return None
    codes: dict[int, None] = {}
    for path, code in entries:
        if type(code) is not int or not 0 <= code <= 255:
            message = f"found {show(code)}, allowed: a function code from 0 to 255"
            section.desk.problem(path, message)
        elif code not in ALL:
            message = f"function {code} does not exist here, and is refused in any case"
            section.desk.note("left out", path, message)
        else:
            codes[code] = None
    return list(codes)


def touching(areas: Iterable[str]) -> frozenset[int]:
    """The functions that read or write these areas."""
    wanted = set(areas)
    return frozenset(each.code for each in FUNCTIONS if each.area in wanted)


def beside(denied: Iterable[int]) -> list[int]:
    """Functions that have to be denied too, as they do what a denied one does."""
    codes = set(denied)
    return [code for code, like in _CLOSE.items() if like & codes and code not in codes]


def rights(allowed: frozenset[int]) -> dict[str, Any]:
    """`access` and, where it takes them, `functions` of a rule that allows exactly these."""
    access = "read-write" if allowed & WRITING else "read-only"
    if allowed in (ALL, READING):
        return {"access": access}
    return {"access": access, "functions": sorted(allowed)}


def spelled(codes: Iterable[int]) -> str:
    """Codes as a message names them."""
    return listing(sorted(codes)) or "none"
