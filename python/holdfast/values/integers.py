"""Integers and booleans of any library, such as NumPy, as those of Python.

A float is neither, also without a fraction. No library is imported for it.
"""

from __future__ import annotations

import operator

_BOOLEANS = ("bool", "bool_")
"""The names of NumPy's boolean."""


def as_integer(value: object) -> int | None:
    """Returns an integer as an `int`; `None` for a boolean and anything else."""
    if type(value) is int:
        return value
    if as_boolean(value) is not None:
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def as_boolean(value: object) -> bool | None:
    """Returns a boolean as a `bool`; `None` for anything else."""
    if isinstance(value, bool):
        return value
    kind = type(value)
    return bool(value) if kind.__module__ == "numpy" and kind.__name__ in _BOOLEANS else None
