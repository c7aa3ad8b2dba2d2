"""Where values of a device are in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.config.models.devices import DestinationConfig
    from holdfast.types import Area


@dataclass(frozen=True)
class Place:
    """Where values of a device are in memory."""

    memory: str
    area: Area
    address: int
    count: int

    @property
    def range(self) -> tuple[Area, int, int]:
        """The place in its memory."""
        return self.area, self.address, self.count


def place_of(into: DestinationConfig, count: int) -> Place:
    """Where a read of that many items goes."""
    return Place(into.memory, into.area, into.address, count)
