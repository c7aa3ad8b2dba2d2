"""How rare the types of values are, and their byte orders: a rare one needs evidence."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from holdfast import values
from holdfast.discovery.byte_order_habits import MIXED, PREFERRED
from holdfast.values.orders import SWAPPED_BYTES

if TYPE_CHECKING:
    from holdfast.discovery.byte_order_habits import Habit

RARITY_BITS = {
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

SIZES = {kind: values.register_count(kind) for kind in RARITY_BITS if kind != "string"}
"""The registers of a value of each type."""

NARROW = {kind for kind, size in SIZES.items() if size == 1}
"""The types of one register, in which words have no order."""

SWAPPED_TEXT = {True: 1.0, False: 5.5}
"""How rare swapped bytes in text are, in bits, on a device that swaps those of numbers and on
others. Devices that swap the bytes of numbers leave text unswapped equally often.
"""


@cache
def rarity(kind: str, order: str, habit: Habit) -> float:
    """How rare a type and its order are in a device with this habit, in bits."""
    bits = RARITY_BITS[kind] + PREFERRED[habit.prefers].get(kind, 0.0)
    if kind == "string":
        swaps = habit.order in SWAPPED_BYTES
        return bits + (SWAPPED_TEXT[swaps] if swaps or order == "BADC" else 0)
    if kind in NARROW:
        return bits
    return bits + (MIXED if order != habit.order else 0)
