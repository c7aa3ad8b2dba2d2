"""Text as a value of a type, to write it."""

from __future__ import annotations

import base64
import binascii
import math
import re
from decimal import Decimal, InvalidOperation
from functools import partial
from typing import TYPE_CHECKING, Any

from holdfast.runtime.text import quote, would_be_zero
from holdfast.values import DoesNotFit

if TYPE_CHECKING:
    from holdfast.values.types import Type

BOOLEANS = {"true": True, "1": True, "false": False, "0": False}

_MAX_DIGITS = 40
"""Of an integer with a point or an exponent. No register type has as many."""

_LONG = ("int64", "uint64")
"""Types with integers that a float does not have."""

_NUMBER = re.compile(r"[+-]?([0-9]{1,400}(\.[0-9]{0,400})?|\.[0-9]{1,400})([eE][+-]?[0-9]{1,3})?")


def from_text(text: str, type: Type, named: str, *, is_measurement: bool = False) -> Any:
    """Parses a text to a value of a type, which may still be outside its range.

    Raises `ValueError`. `named` is the type as messages call it. The numbers in a measured array
    may become 0.
    """
    if type.count is not None:
        return _array(text, type, named, is_measurement)
    if type.base == "string":
        return text
    if type.base == "bytes":
        return _bytes(text, named)
    if type.base in ("bool", "bit"):
        return _boolean(text, named)
    return _number(text.strip(), named, type.is_float)


def _boolean(text: str, named: str) -> bool:
    # Not `True`: programs take other words for false than for true, and a guess can start a motor.
    found = BOOLEANS.get(text)
    if found is None:
        raise ValueError(f"{quote(text)} is not a valid {named}, allowed: true, false, 1 and 0")
    return found


def _number(text: str, named: str, is_float: bool) -> int | float:
    if _NUMBER.fullmatch(text) is None:
        raise ValueError(f"{quote(text)} is not a valid {named}, allowed: a JSON number")
    if is_float:
        number = float(text)
        if math.isinf(number):
            raise ValueError(f"{quote(text)} does not fit {named}")
        if would_be_zero(text):
            raise ValueError(f"{quote(text)} is too small for {named}, which would hold 0")
        return number
    exact = Decimal(text)
    if exact.adjusted() > 20 or exact != exact.to_integral_value():
        raise ValueError(f"{quote(text)} is not a valid {named}")
    return int(exact)


def decimal_from(text: str, type: Type, is_measurement: bool = False) -> int | float:
    """Parses a number with a point or an exponent: for integers to one, if it is whole.

    Raises `DoesNotFit`, also for more digits than a float has where a 64-bit integer needs them,
    and for a number that would become 0, unless it is a measurement.
    """
    number = float(text)
    if math.isinf(number):
        raise DoesNotFit(f"{quote(text)} is not a finite number")
    if not is_measurement and would_be_zero(text):
        raise DoesNotFit(f"{quote(text)} is too small for {type.name}, which would hold 0")
    if type.is_float:
        return number
    exact = Decimal(text)
    if exact.adjusted() < _MAX_DIGITS and exact == exact.to_integral_value():
        return int(exact)
    if type.base in _LONG and Decimal(repr(number)) != exact:
        raise DoesNotFit(f"{quote(text)} has too many digits, allowed with a point: 15")
    return number


def _bytes(text: str, named: str) -> bytes:
    try:
        return base64.b64decode(text.strip(), validate=True)
    except (binascii.Error, ValueError):
        raise ValueError(f"{quote(text)} is not a valid {named}, allowed: base64") from None


def _array(text: str, type: Type, named: str, is_measurement: bool) -> list[Any]:
    import msgspec

    from holdfast.runtime.malformed_json import MALFORMED_JSON

    parse = partial(decimal_from, type=type, is_measurement=is_measurement)
    hook = parse if type.is_number else None
    try:
        items = msgspec.json.Decoder(float_hook=hook).decode(text)
    except msgspec.ValidationError as error:  # Of a number.
        raise ValueError(str(error)) from None
    except (*MALFORMED_JSON, InvalidOperation):
        items = None
    if not isinstance(items, list):
        raise ValueError(f"{quote(text)} is not a valid {named}, allowed: a JSON array")
    if type.base == "bytes":
        return [_bytes(item, named) if isinstance(item, str) else item for item in items]
    return items
