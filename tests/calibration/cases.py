"""The form of a corpus that measures how far the confidence of guesses can be trusted.

A case is a block of registers that was read several times, together with what the registers really
contain. The corpora are `judging.py`, which was made without knowledge of the rules of inference
and must not be used to adjust them, and `tuning.py`, for whoever changes the rules. `judge.py`
compares both with what Holdfast claims.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from holdfast.values.types import parsed

NOW = 1_764_064_800.0
"""The time of the last read of every case, in seconds of Unix time: 2025-11-25 10:00 UTC."""

READS = 5
EVERY_S = 0.5
"""The time between two reads."""

EMPTY = "empty"
"""The type of a register without a value: 0, 0xFFFF or 0x8000. Each is a truth of its own."""

BITS = "bits"
"""The last word of `what` of registers whose bits or bytes are independent of each other."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What one or more registers of a block contain."""

    offset: int
    type: str
    """A type of `holdfast.values`, or `EMPTY`."""
    order: str
    what: str
    """The meaning: `voltage`, `serial number`, `alarm bits`."""

    @property
    def registers(self) -> int:
        """How many registers it takes."""
        return size_of(self.type)

    @property
    def extent(self) -> range:
        """Its registers, as offsets into the block."""
        return range(self.offset, self.offset + self.registers)

    @property
    def is_bits(self) -> bool:
        """Whether its bits or bytes are independent of each other, so that it has no sign."""
        return self.what.split()[-1:] == [BITS]


@dataclass(frozen=True, slots=True)
class Case:
    """A block of registers: five reads, half a second apart, and their contents."""

    name: str
    kind: str
    """The kind of device."""
    live: bool
    """Whether values change between the reads."""
    reads: list[list[int]]
    values: list[Truth]

    def check(self) -> None:
        """Raises `ValueError` unless each register of every read belongs to one truth."""
        if len(self.reads) != READS:
            raise ValueError(f"{self.name} has {len(self.reads)} reads, required: {READS}")
        covered = [at for truth in self.values for at in truth.extent]
        for read in self.reads:
            if covered != list(range(len(read))):
                raise ValueError(
                    f"{self.name}: the truths cover {len(covered)} registers in the order "
                    f"{covered[:8]}…, required: each of the {len(read)} registers once, in order"
                )
        if not self.live and any(read != self.reads[0] for read in self.reads):
            raise ValueError(f"{self.name} changes, but is not live")


@lru_cache(256)
def size_of(type: str) -> int:
    """The registers of a type, 1 for `EMPTY`."""
    return 1 if type == EMPTY else parsed(type).registers
