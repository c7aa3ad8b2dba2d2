"""The configuration that an import is making, as plain data in the order it is written in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from holdfast.types import AREAS


@dataclass
class Draft:
    """The sections so far. `seals` says where the source seals a memory, by our name for it."""

    memories: dict[str, dict[str, Any]] = field(default_factory=dict)
    listeners: dict[str, dict[str, Any]] = field(default_factory=dict)
    rest: dict[str, Any] | None = None
    mqtt: dict[str, Any] | None = None
    seals: dict[str, tuple[str | int, ...]] = field(default_factory=dict)

    def data(self) -> dict[str, Any]:
        """The configuration, without sections that hold nothing."""
        sections = {
            "memories": self.memories,
            "listeners": self.listeners,
            "rest": self.rest,
            "mqtt": self.mqtt,
        }
        return {name: section for name, section in sections.items() if section}

    def grant(self, memories: list[str]) -> dict[str, Any]:
        """All areas that some of these memories have, as a grant names them."""
        there = {area for name in memories for area in self.memories[name]}
        return {"memories": memories, "areas": [area for area in AREAS if area in there]}

    def written_by_raw_ingest(self) -> list[str]:
        """The memories that have an id, by which Raw Ingest with memory ids finds them."""
        return [name for name, memory in self.memories.items() if "id" in memory]
