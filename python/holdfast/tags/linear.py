"""Scale and offset: value = scale × number + offset, and back, without rounding errors.

0.1 means one tenth, not the nearest binary number, so 215 × 0.1 is 21.5.
"""

from __future__ import annotations

import math
from fractions import Fraction


class Linear:
    """A scale and an offset. Raises `ValueError` for a scale of 0 and for numbers without end."""

    def __init__(self, scale: float, offset: float) -> None:
        for name, number in (("scale", scale), ("offset", offset)):
            if not math.isfinite(number):
                raise ValueError(f"{name} is {number}, allowed: a finite number")
        if scale == 0:
            raise ValueError("scale is 0, allowed: any other number")
        self._scale, self._offset = _exact(scale), _exact(offset)
        self._whole = self._scale.denominator == self._offset.denominator == 1
        self._over = math.lcm(self._scale.denominator, self._offset.denominator)
        self._times = self._scale.numerator * (self._over // self._scale.denominator)
        self._plus = self._offset.numerator * (self._over // self._offset.denominator)
        self.is_identity = scale == 1 and offset == 0

    def value(self, number: float | Fraction) -> int | float:
        """The value of a number in the registers; an integer if everything is one."""
        if isinstance(number, int):
            scaled = number * self._times + self._plus
            return scaled if self._whole else scaled / self._over
        if isinstance(number, float) and not math.isfinite(number):
            return number
        try:
            return float(Fraction(number) * self._scale + self._offset)
        except OverflowError:
            return math.copysign(math.inf, number * self._times)

    def number(self, value: float) -> Fraction:
        """The number in the registers for a finite value."""
        return (_exact(value) - self._offset) / self._scale


def _exact(number: float) -> Fraction:
    """The number as it is written."""
    return Fraction(repr(number)) if isinstance(number, float) else Fraction(number)
