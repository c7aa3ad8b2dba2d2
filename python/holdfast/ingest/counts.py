"""The counters of a memory access, and how many reasons of refusals they tell apart."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

MAX_REASONS = 64
"""The most reasons that are counted apart: adapters of other packages have their own."""

OTHER = "other"
"""The reason under which all others are counted."""


@dataclass
class Counts:
    """Counters of one memory access: accepted messages, values written, reads, refusals."""

    accepted: int = 0
    values: int = 0
    reads: int = 0
    refused: Counter[str] = field(default_factory=Counter)

    def refuse(self, reason: str) -> None:
        """Counts a refusal. Reasons beyond `MAX_REASONS` are counted together."""
        known = reason in self.refused or len(self.refused) < MAX_REASONS
        self.refused[reason if known else OTHER] += 1

    def snapshot(self) -> dict[str, object]:
        """Returns a copy of the counters."""
        return {
            "accepted": self.accepted,
            "values": self.values,
            "reads": self.reads,
            "refused": dict(self.refused),
        }
