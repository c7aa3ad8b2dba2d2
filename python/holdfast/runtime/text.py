"""Values and lists in messages. Values come from outside: they can have any size and character."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_CHARACTERS = 40
"""A longer value is cut."""


def clip(text: str, most: int = MAX_CHARACTERS) -> str:
    """The beginning of a text, with `…` if there is more."""
    return text if len(text) <= most else f"{text[:most]}…"


def quote(text: str) -> str:
    """The beginning of a text, in quotes, without control characters."""
    return repr(clip(text))


def either(values: Iterable[object]) -> str:
    """`a`, `a or b`, `a, b or c`; without duplicates."""
    return _listed(values, "or")


def all_of(values: Iterable[object]) -> str:
    """`a`, `a and b`, `a, b and c`; without duplicates."""
    return _listed(values, "and")


def listing(values: Iterable[object]) -> str:
    """`a, b, c`."""
    return ", ".join(str(value) for value in values)


def guess(word: object, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` if a known word is close, else ""."""
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _listed(values: Iterable[object], word: str) -> str:
    *most, last = dict.fromkeys(str(value) for value in values)
    return f"{', '.join(most)} {word} {last}" if most else last
