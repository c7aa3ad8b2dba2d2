"""Markers: what registers hold when a device has no value."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

from holdfast.values import ConversionError, decode, encode

if TYPE_CHECKING:
    from holdfast.values.types import Type

Marker: TypeAlias = bool | int | float | str

FLOATS = ("float16", "float32", "float64")


def as_decoded(marker: Marker, type: Type, encoding: str | None) -> Marker:
    """Converts a marker to the value that is decoded from the registers.

    Raises `ValueError` for a marker that the registers can't hold.
    """
    if type.base == "bytes":
        raise ValueError(f"not supported for {type.name}")
    if marker == "nan" and type.base in FLOATS:
        return math.nan
    try:
        registers = encode(marker, type.element, encoding=encoding)
        made: Marker = decode(registers, type.element, encoding=encoding)
    except (ConversionError, TypeError) as error:
        raise ValueError(str(error)) from None
    return made
