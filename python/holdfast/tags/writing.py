"""What a write puts into the registers of a tag, and what can't be written."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Final

from holdfast.protocol import WRITE_LIMITS
from holdfast.tags.rounding import ROUNDING_OF_WRITES, nearest_step
from holdfast.tags.scale import RegisterScale, ScaledTag, is_finite
from holdfast.types import BIT_AREAS
from holdfast.values import DoesNotFit
from holdfast.values.errors import shown
from holdfast.values.numeric import as_real, nearest_float

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.tags.rounding import Rounding
    from holdfast.tags.scale import Linear
    from holdfast.types import Area
    from holdfast.values.types import Type

_MAX_SHOWN: Final = 100
"""Maximum number of characters of a number in a message."""


class WritableTag(ScaledTag):
    """A tag as writes see it."""

    min: float | None
    max: float | None
    states: Mapping[int, str]
    round: Rounding | None
    _linear: Linear

    @property
    def is_float(self) -> bool:
        """Whether the registers hold floating-point numbers."""
        return self.of_type.is_float

    @property
    def is_number(self) -> bool:
        """Whether the values are numbers, and not bits or text."""
        return self.of_type.is_number

    @property
    def is_stepped(self) -> bool:
        """Whether the values are numbers in steps of `scale`, and not names."""
        return self.is_number and not self.is_float and not self.states

    @property
    def unscaled(self) -> str:
        """What stands in the way while the scale is in a register that was not read."""
        assert isinstance(self.scale, RegisterScale)
        return f"the scale is in {self.scale.where}, which has to be read first"

    def raw(self, value: Any, *, default_round: Rounding = ROUNDING_OF_WRITES) -> Any:
        """What the registers have to hold for a value, or for the name of one.

        Raises `DoesNotFit` for a value that they can't hold, for one below `min` or above `max`,
        and for a number that stands for no value. `default_round` is for a tag without `round`. A
        number that stands for a state is never rounded. Floating-point registers take the nearest
        number, 0 only as a measurement; that of a `float16` can be far off, and is checked again.
        """
        if hasattr(value, "tolist"):
            value = value.tolist()
        if isinstance(value, list | tuple):
            return [self.raw(item, default_round=default_round) for item in value]
        if isinstance(value, str) and self.states:
            value = self._named(value)
        if not self.is_number:
            return value
        real = as_real(value)
        if not isinstance(real, int | float | Fraction):
            raise DoesNotFit(f"{value!r} is not a number")
        if not is_finite(real):
            flaw = "not a finite number" if isinstance(real, float) else "too large"
            raise DoesNotFit(f"{shown(real)} is {flaw}")
        # A float means what is written: as such, 0.1 is equal to a `min` of 0.1.
        is_float = isinstance(real, Fraction) and Fraction(repr(float(real))) == real
        number = float(real) if is_float else real
        if isinstance(self.scale, RegisterScale):
            raise DoesNotFit(self.unscaled)
        found = self._number(number, value, abs(self.scale), default_round)
        if self.null and self.is_null(self._held(found)):
            raise DoesNotFit(f"{_text(value)} stands for no value (`null` in the tag)")
        return found

    def _number(
        self, value: float | Fraction, given: Any, step: float, default_round: Rounding
    ) -> float:
        if flaw := self._beyond(value):
            raise DoesNotFit(f"{_text(given)} is {flaw}")
        if self.is_float:
            number = self._float(value, given)
            held = self._held(number)
            if self.of_type.base == "float16":
                rounded = self._linear.value(held)
                if flaw := self._beyond(rounded):
                    found = f"{_text(given)} is {rounded} in {self.of_type.element}"
                    raise DoesNotFit(f"{found}, {flaw}")
            if held and default_round == "exact":
                return number
            # With an offset, the digits that a float has too much are no reason to refuse 0.
            zero = self._linear.value(0)
            is_zero = zero == value or (float(value) and math.isclose(zero, value, rel_tol=1e-15))
            if default_round == "nearest" or is_zero:
                return held
            raise DoesNotFit(f"{_text(given)} is too small for {self.type}, which would hold 0")
        exact = self._linear.number(value)
        if exact.denominator == 1:
            return exact.numerator
        nearest = nearest_step(exact)
        rounded = self._linear.value(nearest)
        if rounded == value:
            return nearest  # A read returns this value: a float has not all digits of the scale.
        steps = f"steps of {step}"
        if not self.is_stepped or (self.round or default_round) == "exact":
            other = ", or `round: nearest` in the tag" if self.is_stepped and not self.round else ""
            found = f"{_text(given)} is between two values of the registers"
            raise DoesNotFit(f"{found}, allowed: {steps}{other}")
        if flaw := self._beyond(rounded):
            raise DoesNotFit(f"{_text(given)} is {rounded} in {steps}, {flaw}")
        return nearest

    def _float(self, value: float | Fraction, given: Any) -> float:
        if self._linear.is_identity and not isinstance(value, Fraction):
            return value
        try:
            return nearest_float(self._linear.number(value), self.of_type.base)
        except OverflowError:
            raise DoesNotFit(f"{_text(given)} does not fit {self.type}") from None

    def _held(self, number: float) -> float:
        """What the registers make of a number."""
        if not self.is_float:
            return number
        try:
            return nearest_float(number, self.of_type.base)
        except OverflowError:
            return number  # The codec refuses it, and says what the type allows.

    def _beyond(self, value: float | Fraction) -> str | None:
        """What is wrong with a value beyond the limits of the tag."""
        least, most = self.min, self.max
        if (least is None or value >= least) and (most is None or value <= most):
            return None
        if least is not None and most is not None:
            return f"outside {least} to {most}"
        allowed = f"up to {most}" if least is None else f"at least {least}"
        return f"outside the limits, allowed: {allowed}"

    def _named(self, name: str) -> int:
        for value, known in self.states.items():
            if known == name:
                return value
        raise DoesNotFit(f"{name!r} is no state, allowed: {', '.join(self.states.values())}")


def _text(number: Any) -> str:
    """A number for a message, as it was given unless it is long."""
    try:
        text = str(number)
    except ValueError:  # An integer in it has more digits than Python converts.
        return shown(number)
    return text if len(text) <= _MAX_SHOWN else shown(number)


def unwritable(area: Area, type: Type, named: str) -> str | None:
    """Why no Modbus request can write a type to coils or holding registers; `None` if one can.

    `named` is the type as messages call it.
    """
    if type.base == "bit" and type.count is not None:
        return f"{type.name} can't be written, only one bit can"
    most = WRITE_LIMITS[area]
    if type.registers > most:
        kind = "coils" if area in BIT_AREAS else "registers"
        return f"{named} has {type.registers} {kind}, one request writes at most {most}"
    return None
