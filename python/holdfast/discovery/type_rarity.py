"""How rare the types of values are, and their byte orders: a rare one needs evidence."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from holdfast import values
from holdfast.discovery.byte_order_habits import MIXED, PREFERRED
from holdfast.values.orders import SWAPPED_BYTES

if TYPE_CHECKING:
    from holdfast.discovery.byte_order_habits import Habit

RARE = {
    "uint16": 1.0,
    "int16": 0.9,
    "float32": 5.3,
    "uint32": 2.1,
    "int32": 4.5,
    "float64": 6.0,
    "uint64": 7.3,
    "int64": 8.0,
    "bcd16": 8.0,
    "bcd32": 8.5,
    "float16": 18.0,
    "string": 6.0,
}
"""How rare a type is among the values of devices, in bits."""

SIZES = {kind: values.register_count(kind) for kind in RARE if kind != "string"}
"""The registers of a value of each type."""

NARROW = {kind for kind, size in SIZES.items() if size == 1}
"""The types of one register, in which words have no order."""

SWAPPED_TEXT = {True: 1.0, False: 5.5}
"""How rare swapped bytes in text are, in bits, on a device that swaps those of numbers and on
others. The former leaves the text as it is as often.
"""


@cache
def rarity(kind: str, order: str, habit: Habit) -> float:
    """How rare a type and its order are in a device with this habit, in bits."""
    rare = RARE[kind] + PREFERRED[habit.prefers].get(kind, 0.0)
    if kind == "string":
        swaps = habit.order in SWAPPED_BYTES
        return rare + (SWAPPED_TEXT[swaps] if swaps or order == "BADC" else 0)
    if kind in NARROW:
        return rare
    return rare + (MIXED if order != habit.order else 0)
