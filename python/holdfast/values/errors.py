"""What is raised when something can't be converted.

A text says what was found and what is allowed. Places stand before it, outer ones first:
`flow: values[3]: 70000 is outside 0 to 65535 of uint16`.
"""

from __future__ import annotations

import operator
from typing import TypeVar

MAX_SHOWN = 40
LARGEST_SHOWN = 1 << 128


class ConversionError(ValueError):
    """Nothing was converted. `field` is the name of a layout's field, if it was one's."""

    field: str | None = None


class UnknownType(ConversionError):
    """A type that does not exist."""


class UnknownOrder(ConversionError):
    """An order that does not exist, or not for fields of this size."""


class UnknownEncoding(ConversionError):
    """A text encoding that does not exist, or not for this type."""


class WrongArea(ConversionError):
    """A type that an area of bits does not hold, which is any but `bool`."""


class WrongLength(ConversionError):
    """Too few or too many registers or values."""


class InvalidRegister(ConversionError):
    """A register that is no integer of 0 to 65535."""


class Undecodable(ConversionError):
    """Registers that hold no value of the type."""


class DoesNotFit(ConversionError):
    """A value that its type does not hold."""


class InvalidLayout(ConversionError):
    """Fields that make no layout, or none that can be encoded."""


Error = TypeVar("Error", bound=ConversionError)


def at(place: str, error: Error, field: str | None = None) -> Error:
    """The same error with a place before its text."""
    placed = type(error)(f"{place}: {error}")
    placed.field = field
    return placed


def shown(value: object) -> str:
    """A value for a text, cut short: it comes from outside, and may be of any size."""
    if isinstance(value, int) and not -LARGEST_SHOWN < value < LARGEST_SHOWN:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, str | bytes):
        cut = len(value) > MAX_SHOWN
        return f"{value[:MAX_SHOWN]!r}{'…' if cut else ''}"
    if value is None or isinstance(value, int | float):
        return repr(value)
    return f"a {type(value).__name__}"


def is_integer(value: object) -> bool:
    """Whether a value is an integer, of any library, and no bool."""
    if isinstance(value, bool):
        return False
    try:
        operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return False
    return True


def counted(number: int, noun: str) -> str:
    """`1 register`, `2 registers`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
