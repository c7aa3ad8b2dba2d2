"""Whether a value has changed."""

from __future__ import annotations

from typing import Any


def differs(value: Any, last: Any, deadband: float) -> bool:
    """Returns whether a value differs; a number, by more than the deadband."""
    if type(value) is list and type(last) is list:
        pairs = zip(value, last, strict=True)
        return any(differs(one, other, deadband) for one, other in pairs)
    if type(value) in (int, float) and type(last) in (int, float):
        # The difference of two equal infinities is NaN, which is not greater than the deadband.
        return bool(abs(value - last) > deadband)
    return bool(value != last)
