"""The byte interpreter: registers and bits to typed values, and back.

A type says what a field holds (`float32`, `string:20`, `uint16[8]`), an order how its bytes are
arranged on the wire. `decode` and `encode` convert one field, a `Layout` all fields of a block at
once. Everything here is pure: no I/O, no device, no memory.

Nothing is padded, cut, wrapped or clamped. What can't be converted raises a `ConversionError`,
which is a `ValueError`; an argument that is no data at all raises `TypeError`.
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
