"""Judges what reaches callers and memories: every value has to answer its own request."""

from __future__ import annotations

import threading
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from hostile.devices import VERSIONS, tag

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hostile.devices import Device


class Question(NamedTuple):
    """A read of registers."""

    unit: int
    function: int
    address: int
    since: int
    """The number of the last request before it."""


class Judge:
    """Counts right and wrong results, and errors."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.counts: Counter[str] = Counter()
        self.faults: list[str] = []
        """The wrong results, as texts."""
        self._written: list[tuple[int, int, int]] = []
        self._lock = threading.Lock()

    def error(self) -> None:
        """Notes a read that failed."""
        with self._lock:
            self.counts["errors"] += 1

    def read(self, asked: Question, values: Sequence[int]) -> None:
        """Judges values: each names its register, and a request after `since`."""
        received = self.device.received
        wrong = []
        for at, value in enumerate(values):
            age = (received - value) % VERSIONS
            is_its = value // VERSIONS * VERSIONS == tag(
                asked.unit, asked.function, asked.address + at
            )
            if not is_its or received - age <= asked.since:
                wrong.append(value)
        with self._lock:
            self.counts["wrong" if wrong or not values else "right"] += 1
            if wrong or not values:
                shown = [(value // VERSIONS, value % VERSIONS) for value in values]
                expected = tag(asked.unit, asked.function, asked.address) // VERSIONS
                self.faults.append(
                    f"{asked}: {shown}, expected {expected} and more than "
                    f"{asked.since % VERSIONS}; received {received % VERSIONS}"
                )

    def write(self, unit: int, address: int, value: int, *, is_confirmed: bool) -> None:
        """Notes a write and its result."""
        with self._lock:
            if is_confirmed:
                self._written.append((unit, address, value))
            else:
                self.counts["failed writes"] += 1

    def end(self) -> None:
        """Judges the writes: a device that has ended has executed all that were confirmed."""
        for write in self._written:
            is_right = write in self.device.executed
            self.counts["writes" if is_right else "wrong"] += 1
            if not is_right:
                self.faults.append(f"write {write} was confirmed and not executed")
