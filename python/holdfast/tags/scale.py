"""Scale and offset: value = scale × number + offset, and back, without rounding errors.

0.1 means one tenth, not the nearest binary number, so 215 × 0.1 is 21.5. A device may have the
scale in a register, such as the scale factors of SunSpec.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from holdfast.protocol import READ_LIMITS
from holdfast.tags.base import BaseTag, TagError
from holdfast.values.digits import decimal_of
from holdfast.values.errors import shown
from holdfast.values.integers import as_integer

if TYPE_CHECKING:
    from holdfast.values.types import Type

Form: TypeAlias = Literal["factor", "exponent"]

EXPONENTS = range(-10, 11)
"""The exponents that SunSpec allows; 0x8000 is that of a point without a value."""


class ScaledTag(BaseTag):
    """A tag as scales see it."""

    of_type: Type
    scale: float | RegisterScale


@dataclass(frozen=True)
class RegisterScale:
    """Where the scale of a tag is, and what its value means."""

    form: Form
    """`factor`: the value is the scale. `exponent`: the scale is 10 to the power of the value."""
    name: str | None = None
    """The tag of the register, in the same tag list; `None` if only its place is known."""
    source: ScaledTag | None = None
    """The register. With a name, `None` until a tag list has found it."""

    def __str__(self) -> str:
        return f"{self.form} from {self.name or self.where}"

    @property
    def where(self) -> str:
        """The register, for messages."""
        assert self.source is not None, "a tag list finds the registers of all scales"
        return f"{self.source.area} {self.source.address}"

    def check(self, tag: BaseTag) -> None:
        """Raises `TagError` if the request that reads the value of the tag can't read its scale."""
        source = self.source
        if source is None:
            return
        found = f"the scale is from {self.where}"
        if source.area != tag.area:
            raise TagError("scale", f"{found}, allowed: a register in {tag.area}, as the value")
        if not source.of_type.is_number or source.of_type.count is not None:
            raise TagError("scale", f"{found}, type {source.type}, allowed: a single number")
        if source.of_type.is_float and self.form == "exponent":
            raise TagError("scale", f"{found}, type {source.type}, allowed: an integer exponent")
        if isinstance(source.scale, RegisterScale):
            raise TagError("scale", f"{found}, whose own scale is in a register")
        most = READ_LIMITS[tag.area]
        if len(tag.span) > most:
            place = f"{tag.span.start} to {tag.span.stop - 1}"
            raise TagError(
                "scale",
                f"{found}: {place} are {len(tag.span)} registers, one request reads at most "
                f"{most}, and a value is only read together with its scale",
            )

    def factor(self, content: Any) -> float:
        """The scale for the decoded content of the register. Raises `ValueError` without one."""
        assert self.source is not None, "a tag list finds the registers of all scales"
        value: float | None = self.source.value(content)
        if value is None:
            raise ValueError(f"the scale in {self.where} has no value")
        if self.form == "exponent":
            if value not in EXPONENTS:
                allowed = f"exponents from {EXPONENTS[0]} to {EXPONENTS[-1]}"
                raise ValueError(f"the scale in {self.where} is 10^{value}, allowed: {allowed}")
            return 10 ** int(value) if value >= 0 else float(f"1e{int(value)}")
        if isinstance(content, float) and is_finite(content):  # As the tag is shown: in decimal.
            value = self.source.value(Fraction(decimal_of(content, self.source.of_type.base)))
        if not value or not is_finite(value):
            allowed = "a finite number other than 0"
            raise ValueError(f"the scale in {self.where} is {value}, allowed: {allowed}")
        return value

    def linear(self, content: Any, offset: float) -> Linear:
        """Scale and offset for the decoded content of the register. Raises `ValueError`."""
        return linear_of(self.factor(content), offset)


# 2**63 and 2.0**63 are equal, but as they are written, they have other digits.
@lru_cache(1024, typed=True)
def linear_of(scale: float, offset: float) -> Linear:
    """Scale and offset, cached."""
    return Linear(scale, offset)


class Linear:
    """A scale and an offset, both finite. Raises `TagError` for a scale of 0."""

    def __init__(self, scale: float, offset: float) -> None:
        if scale == 0:
            raise TagError("scale", "scale is 0, allowed: any other number")
        self._scale, self._offset = _exact(scale), _exact(offset)
        self._over = math.lcm(self._scale.denominator, self._offset.denominator)
        self._times = self._scale.numerator * (self._over // self._scale.denominator)
        self._plus = self._offset.numerator * (self._over // self._offset.denominator)
        # Integers beyond all floats could not be compared with floats.
        most = (abs(self._times) << 64) + abs(self._plus)
        self._whole = self._over == 1 and is_finite(most)
        self.is_identity = scale == 1 and offset == 0

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Linear):
            return NotImplemented
        return (self._scale, self._offset) == (other._scale, other._offset)

    def __hash__(self) -> int:
        return hash((self._scale, self._offset))

    def value(self, number: float | Fraction) -> int | float:
        """The value of a number, not NaN, in the registers; an integer if everything is one."""
        try:
            if isinstance(number, int):
                scaled = number * self._times + self._plus
                return scaled if self._whole else scaled / self._over
            return float(Fraction(number) * self._scale + self._offset)
        except OverflowError:
            return math.copysign(math.inf, number) * float(self._scale)

    def number(self, value: float | Fraction) -> Fraction:
        """The number in the registers for a finite value."""
        return (_exact(value) - self._offset) / self._scale


def plain_number(key: str, given: object) -> float:
    """A finite number of a tag as a plain `int` or `float`: integers of NumPy would wrap.

    Raises `TagError` for anything else. So for a `float32` of NumPy, which has other digits as a
    `float`: 0.1 would be 0.10000000149011612.
    """
    number = float(given) if isinstance(given, float) else as_integer(given)
    if number is None or not is_finite(number):
        allowed = "a finite number, int or float"
        raise TagError(key, f"{key} is {shown(given)}, allowed: {allowed}")
    return number


def is_finite(number: float | Fraction) -> bool:
    """Whether a number is finite, and no integer beyond all floats."""
    try:
        return math.isfinite(number)
    except OverflowError:
        return False


def _exact(number: float | Fraction) -> Fraction:
    """The number as it is written."""
    return Fraction(repr(number)) if isinstance(number, float) else Fraction(number)
