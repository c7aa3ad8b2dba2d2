"""Which values a host gets as historical, to store them and not to show them as current.

After an outage, the birth of a device has its newest values. Those that waited follow, and are
older.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.polling import Reading


class Births:
    """When the tags of a device had the values of its last birth."""

    def __init__(self) -> None:
        self._times: dict[str, float] = {}

    def add(self, tag: str, reading: Reading | None) -> float:
        """Notes the reading in the birth; now, if there was none. Returns its time."""
        at = self._times[tag] = time.time() if reading is None else reading.time
        return at

    def has(self, reading: Reading) -> bool:
        """Whether it was in the birth."""
        return self._times.get(reading.tag.name) == reading.time

    def is_historical(self, reading: Reading) -> bool:
        """Whether the birth had a newer one.

        A birth that is in the future was before the clock was set back: nobody knows then.
        """
        return reading.time < self._times[reading.tag.name] <= time.time()
