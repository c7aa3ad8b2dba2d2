"""Errors of conversions.

A message says what was found and what is allowed. The place comes first, from outer to inner:
`flow: values[3]: 70000 is outside 0 to 65535 of uint16`.
"""

from __future__ import annotations

from typing import TypeVar

from holdfast.runtime.text import quote

MAX_INTEGER = 1 << 128


class ConversionError(ValueError):
    """Nothing was converted. `field` is the name of the field, if a layout raised the error."""

    field: str | None = None


class UnknownType(ConversionError):
    """The type does not exist."""


class UnknownOrder(ConversionError):
    """The order does not exist, or not for fields of this size."""


class UnknownEncoding(ConversionError):
    """The text encoding does not exist, or not for this type."""


class WrongArea(ConversionError):
    """The type is not allowed in an area of bits, which allows only `bool`."""


class WrongLength(ConversionError):
    """Too few or too many registers or values."""


class InvalidRegister(ConversionError):
    """A register is not an integer from 0 to 65535."""


class Undecodable(ConversionError):
    """The registers are not a valid value of the type."""


class DoesNotFit(ConversionError):
    """The value is outside the range of its type, or of the wrong kind."""


class InvalidLayout(ConversionError):
    """The fields are not a valid layout, or can't be encoded."""


Error = TypeVar("Error", bound=ConversionError)


def at(place: str, error: Error, field: str | None = None) -> Error:
    """A copy of the error, with a place before its message."""
    placed = type(error)(f"{place}: {error}")
    placed.field = field
    return placed


def shown(value: object) -> str:
    """A value for a message, shortened: values come from outside and can have any size."""
    if isinstance(value, int) and not -MAX_INTEGER < value < MAX_INTEGER:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, str | bytes):
        return quote(value)
    if value is None or isinstance(value, int | float):
        return repr(value)
    return f"a {type(value).__name__}"
