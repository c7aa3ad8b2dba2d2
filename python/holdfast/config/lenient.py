"""Looking at data whose shape is not known to be right: what does not fit is as if it were absent.

The checks use it, so that they see what they can whatever else is wrong.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


def mapping(value: object) -> dict[Any, Any]:
    """The value when it is a mapping, else an empty one."""
    return value if isinstance(value, dict) else {}


def entries(value: object) -> list[Any]:
    """The value when it is a list, else an empty one."""
    return value if isinstance(value, list) else []


def fitting(kind: TypeAdapter[T], value: object) -> T | None:
    """The value as the type it should have, `None` when it has not."""
    try:
        return kind.validate_python(value, strict=True)
    except ValidationError:
        return None


def parsed(parse: Callable[[object], T], value: object) -> T | None:
    """What `parse` makes of the value, `None` where it refuses."""
    try:
        return parse(value)
    except ValueError:
        return None


def integer(value: object, least: int, most: int) -> int | None:
    """The value when it is an integer in that range."""
    return value if type(value) is int and least <= value <= most else None
