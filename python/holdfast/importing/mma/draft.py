"""The configuration that an import builds, as plain data in output order."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from holdfast.importing.mma.address_filters import Peers
    from holdfast.importing.mma.listen_addresses import Binds
    from holdfast.importing.notes import Choices, Desk
    from holdfast.types import Area

INGESTED = {"discrete_inputs", "input_registers"}
"""The areas that REST and MQTT could write in the source."""

ADMISSION = {"max_connections_per_source": None, "when_full": "evict"}
"""How the source admitted connections: none was refused, and an address could take all places."""


@dataclass
class Draft:
    """The sections so far. `seals` has the place of each seal in the source, by new memory name."""

    memories: dict[str, dict[str, Any]] = field(default_factory=dict)
    listeners: dict[str, dict[str, Any]] = field(default_factory=dict)
    rest: dict[str, Any] | None = None
    mqtt: dict[str, Any] | None = None
    seals: dict[str, tuple[str | int, ...]] = field(default_factory=dict)

    def data(self) -> dict[str, Any]:
        """The configuration, without empty sections."""
        sections = {
            "memories": self.memories,
            "listeners": self.listeners,
            "rest": self.rest,
            "mqtt": self.mqtt,
        }
        return {name: section for name, section in sections.items() if section}

    def grant(self, memories: list[str]) -> dict[str, Any]:
        """A grant for these memories and for all areas that at least one of them has."""
        there = {area for name in memories for area in self.memories[name]}
        return {"memories": memories, "areas": [area for area in AREAS if area in there]}

    def ingest_grant(self, more: Iterable[Area] = ()) -> dict[str, Any]:
        """A grant of what REST and MQTT may write, for the memories that have some of it.

        That is what they could write, and `more` areas. Empty if no memory has these areas.
        """
        ingested = INGESTED | set(more)
        names = [name for name, memory in self.memories.items() if ingested & memory.keys()]
        grant = self.grant(names)
        areas = [area for area in grant["areas"] if area in ingested]
        return {**grant, "areas": areas} if areas else {}

    def restored(self, granted: Collection[str]) -> list[Area]:
        """The areas that MQTT could also write while their memory was sealed, to restore it."""
        there = {area for name in self.seals for area in self.memories[name]}
        return [area for area in AREAS if area in there and area not in granted]

    def raw_ingest_may_open(self, memory: str) -> bool:
        """Whether a listener takes Raw Ingest packets for a memory: they may write all areas."""
        rules: list[dict[str, Any]] = []
        for listener in self.listeners.values():
            part = listener if listener["type"] == "raw-ingest" else listener.get("raw_ingest", {})
            rules += part.get("rules", [])
        return any(memory in (rule.get("memories") or rule["units"].values()) for rule in rules)

    def written_by_raw_ingest(self) -> list[str]:
        """The memories with an id, which Raw Ingest packets with memory ids can write."""
        return [name for name, memory in self.memories.items() if "id" in memory]


@dataclass
class Reader:
    """What every reader of a part of the source has."""

    desk: Desk
    draft: Draft
    binds: Binds
    admitted: Peers | None
    """The peers that the filter of the whole file admits, `None` without a filter."""
    choices: Choices
