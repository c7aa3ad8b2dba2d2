"""What registers hold for a value that no device has checked: the nearest that they can hold."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

from holdfast.tags.linear import Linear
from holdfast.tags.register_scale import RegisterScale
from holdfast.values.numeric import MAX

if TYPE_CHECKING:
    from holdfast.tags import Tag

MAX_BCD = {"bcd16": 9999, "bcd32": 99_999_999}


def nearest(tag: Tag, value: Any) -> Any:
    """What the registers of one value hold; `None` stands for 0, false or empty."""
    base = tag.of_type.base
    if value is None:
        empty = {"bool": False, "bit": False, "string": "", "bytes": bytes(tag.of_type.parameter)}
        value = empty.get(base)
        if value is None:
            return 0
    if not tag.is_number:
        return value
    if isinstance(value, str):
        return tag.raw(value)
    least, most = _limits(tag)
    number = _linear(tag).number(value)
    if tag.is_float:
        return min(most, max(least, float(number)))
    raw = int(min(most, max(least, round(number))))
    near = itertools.chain(range(raw, int(least) - 1, -1), range(raw, int(most) + 1))
    return next(each for each in near if each not in tag.null)


def extremes(tag: Tag) -> tuple[float, float]:
    """The least and the largest value that the registers of a number can hold."""
    linear = _linear(tag)
    first, second = (linear.value(number) for number in _limits(tag))
    return min(first, second), max(first, second)


def _linear(tag: Tag) -> Linear:
    assert not isinstance(tag.scale, RegisterScale), "the device gives such a tag its scale"
    return Linear(tag.scale, tag.offset)


def _limits(tag: Tag) -> tuple[float, float]:
    base = tag.of_type.base
    if base in MAX:
        return -MAX[base], MAX[base]
    if base in MAX_BCD:
        return 0, MAX_BCD[base]
    bits = int(base.lstrip("uint"))
    return (0, 2**bits - 1) if base.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
