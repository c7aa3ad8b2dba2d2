"""Converts registers and bits to typed values, and back.

A type is the content of a field (`float32`, `string:20`, `uint16[8]`); an order is the arrangement
of its bytes on the wire. `decode` and `encode` convert one field, a `Layout` converts all fields of
a block at once. This package does no I/O.

Values are never padded, truncated, wrapped or clamped. A value that can't be converted raises
`ConversionError`, a `ValueError`. An argument that is not data at all raises `TypeError`.
"""

from __future__ import annotations

from holdfast.values.codec import codec_for, decode, encode, register_count
from holdfast.values.errors import (
    ConversionError,
    DoesNotFit,
    InvalidLayout,
    InvalidRegister,
    Undecodable,
    UnknownEncoding,
    UnknownOrder,
    UnknownType,
    WrongArea,
    WrongLength,
)
from holdfast.values.layout import Field, Layout
from holdfast.values.registers import Registers

__all__ = [
    "ConversionError",
    "DoesNotFit",
    "Field",
    "InvalidLayout",
    "InvalidRegister",
    "Layout",
    "Registers",
    "Undecodable",
    "UnknownEncoding",
    "UnknownOrder",
    "UnknownType",
    "WrongArea",
    "WrongLength",
    "codec_for",
    "decode",
    "encode",
    "register_count",
]
