"""Formats found values for error messages."""

from __future__ import annotations

import re
import unicodedata

from holdfast.runtime.text import clip

MAX_SHOWN = 60

PATH_QUOTES = "write a path in single quotes, or with /"
"""What helps against `\\` in double quotes, where it begins an escape."""


_FOREIGN_SPACE = re.compile(r"\s*?([^\S\x00-\x7f])")


def foreign_space(text: str) -> str | None:
    """The first space before a text that YAML does not take for one; `None` if there is none."""
    found = _FOREIGN_SPACE.match(text)
    if found is None:
        return None
    name = unicodedata.name(found[1], "").lower()
    return f"the character U+{ord(found[1]):04X}{name and f' ({name})'}"


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
    return clip(repr(value), MAX_SHOWN)


def show_file(value: object) -> str:
    """The name of a file that has a secret. Text that is no path may be the secret itself."""
    is_path = isinstance(value, str) and len(value) <= MAX_SHOWN and set("./\\") & set(value)
    return show(value) if is_path else shape(value)


def shape(value: object) -> str:
    """The kind of a value that may be a secret."""
    if isinstance(value, str):
        return f"text of {len(value)} characters"
    return "a number" if type(value) in (int, float) else show(value)
