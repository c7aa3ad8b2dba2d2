"""Whether a value has changed."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

_ROUNDING = 1e-15
"""By how much of two values their difference can be off, as each of them is rounded."""


def differs(value: Any, last: Any, deadband: float) -> bool:
    """Returns whether a value differs; a number, by more than the deadband."""
    if type(value) is list and type(last) is list:
        pairs = zip(value, last, strict=True)
        return any(differs(one, other, deadband) for one, other in pairs)
    if type(value) in (int, float) and type(last) in (int, float):
        # The difference of two equal infinities is NaN, which is not greater than the deadband.
        difference = abs(value - last)
        if deadband and abs(difference - deadband) <= _ROUNDING * (abs(value) + abs(last)):
            # In binary, 0.3 - 0.2 is less than 0.1, and 0.4 - 0.3 is more.
            return abs(_exact(value) - _exact(last)) > _exact(deadband)
        return bool(difference > deadband)
    return bool(value != last)


def _exact(number: float) -> Decimal:
    """The number as it is written."""
    return Decimal(repr(number))
