"""What registers can hold, and what they hold for a value that no device has checked."""

from __future__ import annotations

import contextlib
import itertools
import math
from typing import TYPE_CHECKING, Any

from holdfast.tags.scale import Linear, RegisterScale, is_finite
from holdfast.tags.text import text_of
from holdfast.values import DoesNotFit, codec_for
from holdfast.values.digits import shortest
from holdfast.values.errors import shown
from holdfast.values.numeric import limits, nearest_float

if TYPE_CHECKING:
    from fractions import Fraction

    from holdfast.tags import Tag

_INFINITE = (math.inf, -math.inf)


def nearest(tag: Tag, value: Any) -> Any:
    """What the registers of one value hold; `None` stands for 0, false or empty."""
    base = tag.of_type.base
    if value is None:
        empty = {"bool": False, "bit": False, "string": "", "bytes": bytes(tag.of_type.parameter)}
        value = empty.get(base)
        if value is None:
            return 0
    if isinstance(value, str) and tag.states:
        value = next(number for number, name in tag.states.items() if name == value)
    if not tag.is_number:
        return value
    if tag.is_float and value in _INFINITE:
        return math.copysign(value, value * tag.scale)
    least, most = _limits(tag)
    linear = _linear(tag)
    if tag.is_float:
        # A fraction has no sign of zero.
        exact = value if linear.is_identity else linear.number(value)
        return nearest_float(min(most, max(least, exact)), base)
    number = linear.number(value)
    raw = int(min(most, max(least, round(number))))
    near = itertools.chain(range(raw, int(least) - 1, -1), range(raw, int(most) + 1))
    return next(each for each in near if each not in tag.null)


def extremes(tag: Tag) -> tuple[float, float]:
    """The least and the largest value that the registers of a number can hold."""
    linear = _linear(tag)
    first, second = (linear.value(number) for number in _limits(tag))
    return min(first, second), max(first, second)


class Capacity:
    """The values that the registers of a tag can hold. `place` is that of a scale in a register."""

    def __init__(self, tag: Tag, place: str = "") -> None:
        self._tag = tag
        self._place = place
        if tag.is_number:
            self._least, self._most = extremes(tag)

    def check(self, value: Any) -> None:
        """Raises `DoesNotFit` for a value that would become another one. Steps may round it.

        `None` stands for an empty value, and a single value for all elements of an array. A float
        can be infinite.
        """
        tag = self._tag
        if not isinstance(value, list):
            self._check_one(value)
            return
        for each in value:
            self._check_one(each)
        if len(value) != (tag.of_type.count or 1):
            found = f"{tag.name}: {tag.type} takes {tag.of_type.count or 1} values"
            raise DoesNotFit(f"{found}, found {len(value)}")

    def _check_one(self, value: Any) -> None:
        tag = self._tag
        if value is None:
            return
        if isinstance(value, str):
            value = next((number for number, name in tag.states.items() if name == value), value)
        if not tag.is_number:
            try:
                codec_for("holding_registers", tag.of_type.element, tag.order, tag.encoding).encode(
                    value
                )
            except ValueError as error:
                raise DoesNotFit(f"{tag.name}: {error}") from None
            return
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DoesNotFit(f"{tag.name}: {value!r} is not a number")
        if tag.is_float and value in _INFINITE:
            return
        if not is_finite(value):
            raise DoesNotFit(f"{tag.name}: {shown(value)} is not a finite number")
        if not tag.null and self._least <= value <= self._most:
            return
        number = _linear(tag).number(value)
        raw: float | Fraction = number if tag.is_float else round(number)
        if raw in tag.null:
            raise DoesNotFit(f"{tag.name}: found {self._text(value)}, which stands for no value")
        least, most = _limits(tag)
        if tag.is_float:
            with contextlib.suppress(OverflowError):  # It is outside then.
                raw = nearest_float(raw, tag.of_type.base)
        if not least <= raw <= most:
            held = tag.value(nearest(tag, value))
            raise DoesNotFit(
                f"{tag.name} holds {self._number(self._least)} to {self._text(self._most)} "
                f"({self._how}), found {self._text(value)}; the nearest is {self._text(held)}"
            )

    def _number(self, value: float) -> str:
        if self._tag.is_float:
            return text_of(self._tag, value, states=False)
        return shortest(value, "") if isinstance(value, float) else str(value)

    def _text(self, value: float) -> str:
        unit = self._tag.unit
        return f"{self._number(value)}{f' {unit}' if unit else ''}"

    @property
    def _how(self) -> str:
        """Why it is this range."""
        tag = self._tag
        how = tag.type
        if self._place or tag.scale != 1:
            how += f", scale {tag.scale}{f' in {self._place}' if self._place else ''}"
        return how if tag.offset == 0 else f"{how}, offset {tag.offset}"


def _linear(tag: Tag) -> Linear:
    assert not isinstance(tag.scale, RegisterScale), "the device gives such a tag its scale"
    return Linear(tag.scale, tag.offset)


def _limits(tag: Tag) -> tuple[float, float]:
    """The least and the largest number that the registers can hold and that is a value."""
    least, most = limits(tag.of_type.base)
    if tag.is_float:
        return least, most
    while least in tag.null:
        least += 1
    while most in tag.null:
        most -= 1
    return least, most
