"""Readings for tests of outputs."""

from __future__ import annotations

from typing import Any

from holdfast.polling import Reading
from holdfast.tags import Tag

TIME = 1_700_000_000.25
"""2023-11-14T22:13:20.25Z."""


def tag(name: str = "t", **more: Any) -> Tag:
    settings: dict[str, Any] = {"area": "input_registers", "address": 0, "type": "float64"}
    return Tag(name, **(settings | more))


def reading(value: Any = 1.5, at: float = TIME, **more: Any) -> Reading:
    of = more.pop("tag", tag())
    return Reading(more.pop("device", "pump"), of, value, at, **more)


def numbered(count: int, start: int = 0) -> list[Reading]:
    """Readings whose values are their numbers."""
    return [reading(number, TIME + number) for number in range(start, start + count)]


def polls(count: int, start: int = 0) -> list[list[Reading]]:
    """The same, each in a poll of its own."""
    return [[each] for each in numbered(count, start)]


def numbers(readings: list[Reading]) -> list[int]:
    return [reading.value for reading in readings]
