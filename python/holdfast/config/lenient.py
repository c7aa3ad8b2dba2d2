"""Reads data that is not validated: a value of the wrong type counts as absent.

The checks use it to find as many problems as possible in an invalid file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


def mapping(value: object) -> dict[Any, Any]:
    """The value if it is a mapping, else an empty mapping."""
    return value if isinstance(value, dict) else {}


def entries(value: object) -> list[Any]:
    """The value if it is a list, else an empty list."""
    return value if isinstance(value, list) else []


def fitting(kind: TypeAdapter[T], value: object) -> T | None:
    """The value if it is valid for `kind`, else `None`."""
    try:
        return kind.validate_python(value)
    except ValidationError:
        return None


def parsed(parse: Callable[[object], T], value: object) -> T | None:
    """The result of `parse`, `None` if it raises `ValueError`."""
    try:
        return parse(value)
    except ValueError:
        return None


def integer(value: object, least: int, most: int) -> int | None:
    """The value if it is an integer from `least` to `most`, else `None`."""
    return value if type(value) is int and least <= value <= most else None
