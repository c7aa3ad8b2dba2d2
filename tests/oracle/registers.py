"""Linearizability of a register whose values are all different: exact, in n log n steps.

After Gibbons and Korach, "Testing shared memories", SIAM Journal on Computing 26 (1997). All
operations with one value form a cluster: the write, and the reads of it. Nothing else can come
between them. If one of them has ended before another one has begun, the value was certainly there
in between: that is the zone of the cluster, a forward zone. If all of them overlap, the zone is
their common time, a backward zone. The history is linearizable if and only if no read ends before
its write begins, no two forward zones overlap, and no backward zone lies within a forward zone.
"""

from __future__ import annotations

import bisect
import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from oracle.history import Outcome
from oracle.violation import Violation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from oracle.history import Operation
    from oracle.layout import Block


@dataclass(eq=False)
class Cluster:
    """A value: who wrote it, and who saw it."""

    id: int
    write: Operation | None
    """`None` for the value that was there before the first operation."""
    reads: list[Operation] = field(default_factory=list)
    first_end: float = -math.inf
    """When the first of its operations ended."""
    last_begin: float = -math.inf
    """When the last of its operations began."""

    def settle(self) -> None:
        """Computes the zone, when all operations are known."""
        if self.write is not None:
            self.first_end = min([self.write.end, *(read.end for read in self.reads)])
        begins = [read.begin for read in self.reads]
        begins += [self.write.begin] if self.write is not None else []
        self.last_begin = max(begins, default=-math.inf)

    @property
    def is_forward(self) -> bool:
        return self.first_end < self.last_begin

    @property
    def operations(self) -> list[Operation]:
        return ([] if self.write is None else [self.write]) + self.reads

    def witness(self) -> list[Operation]:
        """The write, and the operation that began last."""
        last = max(self.operations, key=lambda one: one.begin)
        return self.operations[:1] if last is self.operations[0] else [self.operations[0], last]


def conflicts(block: Block, clusters: Iterable[Cluster]) -> Iterator[Violation]:
    """Whatever makes it impossible that one moment of each operation explains all that was seen."""
    clusters = list(clusters)
    for cluster in clusters:
        if cluster.write is not None:
            yield from _from_the_future(block, cluster, cluster.write)
    forward = sorted((each for each in clusters if each.is_forward), key=lambda one: one.first_end)
    reach = _by_reach(forward)
    for before, cluster in zip(reach, forward[1:], strict=False):
        if before.last_begin > cluster.first_end:
            yield _stale(block, before, cluster)
    starts = [each.first_end for each in forward]
    for cluster in clusters:
        if not cluster.is_forward:
            at = bisect.bisect_left(starts, cluster.last_begin) - 1
            if at >= 0 and reach[at].last_begin > cluster.first_end:
                yield _stale(block, reach[at], cluster)


def _by_reach(forward: list[Cluster]) -> list[Cluster]:
    """For each of them, the one up to it whose zone ends last."""
    return list(itertools.accumulate(forward, _later))


def _later(one: Cluster, other: Cluster) -> Cluster:
    return max(one, other, key=lambda each: each.last_begin)


def _from_the_future(block: Block, cluster: Cluster, write: Operation) -> Iterator[Violation]:
    early = [read for read in cluster.reads if read.end < write.begin]
    if early:
        text = f"{block.name}: {cluster.id} was read before its write began"
        yield Violation("future", text, (write, early[0]))


def _stale(block: Block, around: Cluster, within: Cluster) -> Violation:
    text = (
        f"{block.name}: {within.id} was there between two operations with {around.id}, "
        "which was written once"
    )
    return Violation("stale", text, tuple(around.witness() + within.witness()))


def is_visible(operation: Operation) -> bool:
    """Whether its writes have happened, or may have."""
    return operation.outcome is not Outcome.REFUSED
