"""How a written value between two steps is rounded by default, and what the steps are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from fractions import Fraction

Rounding: TypeAlias = Literal["nearest", "exact"]

ROUNDING_OF_WRITES: Rounding = "exact"
ROUNDING_OF_MESSAGES: Rounding = "nearest"
"""Those of tags without `round`. A published measurement has more digits than registers; a value
that somebody sets is meant as it stands.
"""


def nearest_step(number: Fraction) -> int:
    """The nearest whole number; of two equally near ones the even one."""
    return round(number)
