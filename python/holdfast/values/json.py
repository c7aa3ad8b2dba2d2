"""Typed values in JSON: bytes in hex, and `null` for NaN, infinity and what can't be decoded.

Tags have a form of their own, with bytes in base64: `holdfast.tags.strict_text`.
"""

from __future__ import annotations

import math
from typing import Any

from holdfast.values.errors import ConversionError


def jsonable(value: Any) -> Any:
    """Returns a decoded value, or the error of one, in its JSON form."""
    if isinstance(value, bytes):
        return value.hex()
    is_no_number = isinstance(value, float) and not math.isfinite(value)
    if is_no_number or isinstance(value, ConversionError):
        return None
    return value
