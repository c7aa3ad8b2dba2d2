"""Habits of devices: in which order they have bytes, and which types they prefer."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

ORDERS = ("ABCD", "CDAB", "DCBA", "BADC")


class Habit(NamedTuple):
    """How a device orders bytes, and which values it prefers."""

    order: str
    swaps_registers: bool = False
    """Whether the bytes of values of one register are swapped too."""
    prefers: str = ""
    """A key of `PREFERENCES`."""


ORDER_HABITS = {
    Habit("ABCD"): 0.8,
    Habit("CDAB"): 1.2,
    Habit("DCBA"): 4.0,
    Habit("BADC"): 4.0,
    Habit("DCBA", swaps_registers=True): 5.0,
    Habit("BADC", swaps_registers=True): 5.0,
}
"""How rare a habit with bytes is among devices, in bits."""

PREFERENCES = {"": 0.7, "short": 2.3, "long": 2.3, "floats": 2.5}
"""How rare a preference is among devices, in bits."""

PREFERRED = {
    "": {},
    "short": {"uint16": -0.4, "float32": 3.0, "uint32": 3.0, "int32": 3.0},
    "long": {"uint16": 3.0, "int16": 3.0, "uint32": -2.0, "int32": -2.0},
    "floats": {"uint16": 1.0, "float32": -2.0, "uint32": 1.0, "int32": 1.0},
}
"""What a preference adds to the bits of a type. Many devices have numbers of one register only, and
many have long ones throughout, also for states and other small numbers, or floats. So one evident
value tells something about all the others.
"""

HABITS = {
    Habit(habit.order, habit.swaps_registers, preference): rare + more
    for habit, rare in ORDER_HABITS.items()
    for preference, more in PREFERENCES.items()
}
"""How rare a habit is among devices, in bits."""

COMMON = ("ABCD", "CDAB")
MIXED = 4.0
"""The common orders, and how rare it is that a value has one that is not that of its device: a
single register between long values would else be half of one in the other order.
"""


def order_shares(habits: Mapping[Habit, float]) -> dict[str, float]:
    """The probability of each order, from that of each habit."""
    shares: dict[str, float] = {}
    for habit, share in habits.items():
        shares[habit.order] = shares.get(habit.order, 0.0) + share
    return shares
