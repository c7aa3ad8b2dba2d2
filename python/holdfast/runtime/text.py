"""Values and lists in messages, and numbers in text.

Values come from outside: they can have any size and character.
"""

from __future__ import annotations

import os
import re
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_CHARACTERS = 40
"""A longer value is cut."""

_FIRST_OF_WINSOCK = 10_000
"""Errors of sockets on Windows, which `os.strerror` does not know, have no lower number."""


def would_be_zero(text: str) -> bool:
    """Whether a decimal other than 0 is so small that its float is 0."""
    return float(text) == 0 and re.search("[1-9]", re.split("[eE]", text)[0]) is not None


def clip(text: str, most: int = MAX_CHARACTERS) -> str:
    """The beginning of a text, with `…` if there is more."""
    return text if len(text) <= most else f"{text[:most]}…"


def quote(value: str | bytes) -> str:
    """The beginning of a text or of bytes, in quotes, without control characters."""
    return f"{value[:MAX_CHARACTERS]!r}{'…' if len(value) > MAX_CHARACTERS else ''}"


def either(values: Iterable[object]) -> str:
    """`a`, `a or b`, `a, b or c`; without duplicates."""
    return _listed(values, "or")


def all_of(values: Iterable[object]) -> str:
    """`a`, `a and b`, `a, b and c`; without duplicates."""
    return _listed(values, "and")


def listing(values: Iterable[object]) -> str:
    """`a, b, c`."""
    return ", ".join(str(value) for value in values)


def counted(count: int, noun: str) -> str:
    """`1 register`, `2 registers`, `2 addresses`."""
    return f"{count} {noun}{'' if count == 1 else 'es' if noun.endswith('s') else 's'}"


def extent(numbers: range) -> str:
    """`5 to 9`."""
    return f"{numbers.start} to {numbers.stop - 1}"


def sentence(text: str) -> str:
    """A text with a full stop, unless it has an end of its own, such as that of `suggestion`."""
    return text if not text or text.endswith((".", "?", "!")) else f"{text}."


def file_error_text(error: OSError) -> str:
    """An error of the system with its file, and without its number."""
    text = error.strerror or str(error)
    return text if error.filename is None else f"{error.filename}: {text}"


def error_text(number: int) -> str:
    """The system's text for an error number."""
    if sys.platform == "win32" and number >= _FIRST_OF_WINSOCK:
        import ctypes

        return ctypes.FormatError(number)
    return os.strerror(number)


def os_error_text(error: OSError) -> str:
    """The system's text for an error. On Windows, `errno` is often 22 for want of a better one."""
    # Errors of lookups and of TLS have numbers of their own.
    if error.strerror and type(error).__module__ != "builtins":
        return error.strerror
    if sys.platform == "win32" and error.winerror:
        import ctypes

        return ctypes.FormatError(error.winerror)
    return str(error) if error.errno is None else error_text(error.errno)


def _listed(values: Iterable[object], word: str) -> str:
    *most, last = dict.fromkeys(str(value) for value in values)
    return f"{', '.join(most)} {word} {last}" if most else last
