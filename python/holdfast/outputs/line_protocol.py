"""The line protocol of InfluxDB, which Telegraf, VictoriaMetrics and QuestDB read too.

One line has the values that a device gave at one time, one field for each tag. What `has_field`
refuses is a missing field.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from holdfast.tags.scale import RegisterScale, linear_of
from holdfast.tags.text import plain
from holdfast.values.numeric import limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from holdfast.polling import Reading

MIN_INTEGER, MAX_INTEGER = -(2**63), 2**63 - 1
"""Integers of the protocol have 64 bits. Others become floats."""

# The configuration refuses names that nothing here can escape.
_NAME = str.maketrans({",": r"\,", " ": r"\ "})
_KEY = str.maketrans({",": r"\,", " ": r"\ ", "=": r"\="})
_TEXT = str.maketrans({'"': r"\"", "\\": r"\\", "\n": r"\\n", "\r": r"\\r", "\f": r"\\f"})
"""Texts come from devices. VictoriaMetrics ends a line at each newline, also within quotes: the
values of the line would be lost, and the rest of the text could be a line of another device.
Telegraf refuses `\\r` and `\\f`. No escape stands for these: the receiver stores a backslash and a
letter.
"""


def has_field(value: Any) -> bool:
    """Whether there is a field for a value, or for any item of an array."""
    if isinstance(value, list):
        return any(map(has_field, value))
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def lines(readings: Iterable[Reading], measurement: str, tags: Mapping[str, str]) -> bytes:
    """The lines of readings. Empty if no reading has a value."""
    points: dict[tuple[str, int], list[str]] = {}
    for device, tag, value, time, _, _ in readings:
        at = round(time * 1_000_000) * 1000
        fields = points.setdefault((device, at), [])
        # A field has one kind, and whether a scale in a register makes a float depends on the
        # register: all are floats.
        is_float = isinstance(tag.scale, RegisterScale) or (
            tag.is_number and not tag.is_float and _is_wide(tag.of_type.base, tag.scale, tag.offset)
        )
        shown = plain(tag, _as_float(value) if is_float else value)
        fields += [f"{key.translate(_KEY)}={written}" for key, written in _fields(tag.name, shown)]
    name = measurement.translate(_NAME)
    more = "".join(f",{key.translate(_KEY)}={value.translate(_KEY)}" for key, value in tags.items())
    return "".join(
        f"{name},device={device.translate(_KEY)}{more} {','.join(fields)} {at}\n"
        for (device, at), fields in points.items()
        if fields
    ).encode()


@lru_cache(1024, typed=True)
def _is_wide(base: str, scale: float, offset: float) -> bool:
    """Whether some values of a type of integers do not fit the integers of the protocol."""
    linear = linear_of(scale, offset)
    return any(not MIN_INTEGER <= linear.value(end) <= MAX_INTEGER for end in limits(base))


def _as_float(value: Any) -> Any:
    """An integer, or each one of an array, as a float."""
    if isinstance(value, list):
        return [_as_float(item) for item in value]
    return float(value) if type(value) is int else value


def _fields(name: str, value: Any) -> Iterable[tuple[str, str]]:
    """A field, or one for each item of an array."""
    if isinstance(value, list):
        for index, item in enumerate(value):
            yield from _fields(f"{name}[{index}]", item)
    elif has_field(value):
        yield name, _written(value)


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value}i" if MIN_INTEGER <= value <= MAX_INTEGER else repr(float(value))
    if isinstance(value, float):
        return repr(value)
    assert isinstance(value, str), "all others have another form, or no field"
    return f'"{value.translate(_TEXT)}"'
