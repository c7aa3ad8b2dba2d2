"""What a write puts into the registers of a tag, and what can't be written."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from holdfast.protocol import WRITE_LIMITS
from holdfast.tags.scale import RegisterScale
from holdfast.types import BIT_AREAS
from holdfast.values import DoesNotFit

if TYPE_CHECKING:
    from holdfast.tags.scale import Linear
    from holdfast.tags.tag import Rounding, Tag
    from holdfast.types import Area
    from holdfast.values.types import Type


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


def raw_of(tag: Tag, value: Any, linear: Linear, default_round: Rounding) -> Any:
    """What the registers have to hold, see `Tag.raw`; `linear` is the scale of the tag."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [raw_of(tag, item, linear, default_round) for item in value]
    if isinstance(value, str) and tag.states:
        value = _named(tag, value)
    if not tag.is_number:
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DoesNotFit(f"{value!r} is not a number")
    if not math.isfinite(value):
        raise DoesNotFit(f"{value} is not a finite number")
    if isinstance(tag.scale, RegisterScale):
        raise DoesNotFit(tag.unscaled)
    _check_limits(tag, value, f"{value} is")
    if tag.is_float:
        return value if linear.is_identity else float(linear.number(value))
    exact = linear.number(value)
    if exact.denominator == 1:
        return exact.numerator
    steps = f"steps of {abs(tag.scale)}"
    if not tag.is_stepped or (tag.round or default_round) == "exact":
        raise DoesNotFit(f"{value} is between two values of the registers, allowed: {steps}")
    nearest = round(exact)
    rounded = linear.value(nearest)
    _check_limits(tag, rounded, f"{value} is {rounded} in {steps},")
    return nearest


def _check_limits(tag: Tag, value: float, found: str) -> None:
    least, most = tag.min, tag.max
    if (least is not None and value < least) or (most is not None and value > most):
        allowed = f"{'' if least is None else least} to {'' if most is None else most}"
        raise DoesNotFit(f"{found} outside {allowed.strip()}")


def _named(tag: Tag, name: str) -> int:
    for value, known in tag.states.items():
        if known == name:
            return value
    raise DoesNotFit(f"{name!r} is no state, allowed: {', '.join(tag.states.values())}")
