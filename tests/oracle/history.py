"""What clients asked and saw, with the times before each request and after each reply."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from oracle.layout import Block, Kind, Layout, Range

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


class Outcome(Enum):
    """What a client knows about its request."""

    DONE = "done"
    REFUSED = "refused"
    """Nothing was changed."""
    UNKNOWN = "unknown"
    """There is no reply: it may have been carried out, and it may still be."""


class Reading(NamedTuple):
    """What a reply has of a range."""

    range: Range
    values: tuple[int, ...]


class Write(NamedTuple):
    """What a request puts into a block."""

    block: Block
    id: int


@dataclass(frozen=True, eq=False, slots=True)
class Operation:
    """One request. It takes effect at one moment between its begin and its end, or never."""

    face: str
    name: str
    begin: float
    end: float
    """Infinite if it is not known when it has taken effect."""
    outcome: Outcome
    writes: tuple[Write, ...] = ()
    readings: tuple[Reading, ...] = ()
    is_open: bool | None = None
    """Whether the reply shows that the memory was open, or sealed; `None` if it shows neither."""

    def __str__(self) -> str:
        to = ", ".join(f"{write.block.name}={write.id}" for write in self.writes)
        end = "…" if math.isinf(self.end) else f"{self.end / 1e9:.6f}"
        span = f"[{self.begin / 1e9:.6f}, {end}]"
        return f"{self.face} {self.name} {self.outcome.value} {span}" + (f" {to}" if to else "")


class Version(NamedTuple):
    """A value that a device had."""

    id: int
    begin: float
    """When the device took it, at the earliest."""


@dataclass
class History:
    """All operations of a round, and what was there before it."""

    layout: Layout
    operations: list[Operation] = field(default_factory=list)
    initial: dict[Block, int] = field(default_factory=dict)
    """Ids that blocks have before the first operation; by default 0."""
    versions: dict[Block, list[Version]] = field(default_factory=dict)
    """All that a device had, in its order, for each mirrored block."""

    def decoded(self, operation: Operation) -> Iterator[tuple[Block, int | None]]:
        """The blocks that an operation has read, with their ids."""
        for reading in operation.readings:
            for block, offset in self.layout.inside(reading.range):
                yield block, block.decode(reading.values[offset : offset + block.count])

    def lines(self) -> str:
        """All operations by their begin, for people who look for a cause."""
        lines = []
        for operation in sorted(self.operations, key=lambda each: each.begin):
            seen = " ".join(f"{block.name}:{found}" for block, found in self.decoded(operation))
            lines.append(f"{operation}  {seen} {operation.is_open or ''}\n")
        for block, versions in self.versions.items():
            lines += [f"{block.name}={each.id} at {each.begin / 1e9:.6f}\n" for each in versions]
        return "".join(lines)


class Recorder:
    """Collects the operations of all clients. Appending to a list is safe in all threads."""

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.surprises: list[str] = []
        """Replies that no rule of the documentation explains."""

    def add(self, operation: Operation) -> None:
        self.operations.append(operation)

    def surprise(self, text: str) -> None:
        self.surprises.append(text)


class Ids:
    """Ids that a block has never had, or not for a very long time."""

    def __init__(self, blocks: Iterable[Block]) -> None:
        self._next = {block: itertools.count(1) for block in blocks}
        self.taken: set[tuple[Block, int]] = set()
        """Ids that must not be used again: of writes that may still come."""

    def draw(self, block: Block) -> int:
        """The next id. It is smaller than the one before only when all are used up."""
        if block.kind is Kind.OWNED:
            raise AssertionError(f"{block.name} has values, not ids")
        while True:
            # `next` of a count is one step for all threads.
            found = (next(self._next[block]) - 1) % block.max_id + 1
            if (block, found) not in self.taken:
                return found


def now() -> int:
    """Nanoseconds of a clock that all threads share."""
    return time.monotonic_ns()
