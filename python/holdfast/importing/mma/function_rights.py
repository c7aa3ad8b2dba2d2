"""Converts lists of function codes to the keys of a rule."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.text.messages import show
from holdfast.protocol import (
    FUNCTIONS,
    OPTIONAL_CODES,
    WRITING_CODES,
)
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.importing.key_reader import Section

SOURCE = frozenset({1, 2, 3, 4, 5, 6, 15, 16})
"""Functions that the source supports; it refuses all others."""

_SERVED = [each for each in FUNCTIONS if each.code not in OPTIONAL_CODES]
"""What a listener serves without settings that no source has."""

ALL = frozenset(each.code for each in _SERVED)
WRITING = frozenset(WRITING_CODES)
READING = ALL - WRITING
WRITING_ONLY = SOURCE & WRITING
"""Functions that only write: without 23, and without 22, whose result reveals bits."""

OTHERS = frozenset(each.code for each in _SERVED if each.area is None)
"""Functions that access no area."""

_CLOSE = {22: {6, 16}, 23: {3, 6, 16}}
"""Functions with the effect of others: a peer that is denied those must not have these."""


def read_codes(section: Section, key: str) -> list[int] | None:
    """The supported codes of a list, without duplicates; `None` without a list."""
    entries = section.entries(key)
    if entries is None:
        return None
    codes: dict[int, None] = {}
    for path, code in entries:
        if type(code) is not int or not 0 <= code <= 255:
            message = f"found {show(code)}, allowed: a function code from 0 to 255"
            section.desk.problem(path, message)
        elif code not in ALL:
            message = f"function {code} is not supported, so it is always refused"
            section.desk.left_out(path, message)
        else:
            codes[code] = None
    return list(codes)


def touching(areas: Iterable[str]) -> frozenset[int]:
    """The functions that read or write these areas."""
    wanted = set(areas)
    return frozenset(each.code for each in FUNCTIONS if each.area in wanted)


def with_same_effect(denied: Iterable[int]) -> list[int]:
    """Functions that must be denied too, because they have the effect of a denied function."""
    codes = set(denied)
    return [code for code, like in _CLOSE.items() if like & codes and code not in codes]


def rights(allowed: frozenset[int]) -> dict[str, Any]:
    """`access`, and `functions` if necessary, of a rule that allows exactly these functions."""
    access = "read-write" if allowed & WRITING else "read-only"
    if allowed in (ALL, READING):
        return {"access": access}
    return {"access": access, "functions": sorted(allowed)}


def spelled(codes: Iterable[int]) -> str:
    """Codes as text for a message."""
    return listing(sorted(codes)) or "none"
