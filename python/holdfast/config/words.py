"""Formats values for error messages: found values, and lists of allowed values."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_SHOWN = 60


def show(value: object) -> str:
    """A value for a message: scalars as they are, text in quotes, a mapping or list by its kind."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a mapping" if value else "an empty mapping"
    if isinstance(value, list | tuple):
        return "a list" if value else "an empty list"
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


def shape(value: object) -> str:
    """The kind of a value that may be a secret."""
    if isinstance(value, str):
        return f"text of {len(value)} characters"
    return "a number" if type(value) in (int, float) else show(value)


def choice(values: Iterable[object]) -> str:
    """`a`, `a or b`, `a, b or c`; without duplicates."""
    *most, last = dict.fromkeys(str(value) for value in values)
    return f"{', '.join(most)} or {last}" if most else last


def listing(values: Iterable[object]) -> str:
    """`a, b, c`."""
    return ", ".join(str(value) for value in values)


def guess(word: object, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` if a known word is close, else ""."""
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
