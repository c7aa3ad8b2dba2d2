"""Whether a written value between two values of the registers is rounded or refused."""

from __future__ import annotations

from typing import Literal, TypeAlias

Rounding: TypeAlias = Literal["nearest", "exact"]

ROUNDING_OF_WRITES: Rounding = "exact"
ROUNDING_OF_MESSAGES: Rounding = "nearest"
"""Those of tags without `round`. A published measurement has more digits than registers; a value
that somebody sets is meant as it stands.
"""
