"""Judges a history: every promise about reads and writes of a memory, without any I/O.

* A read of a block has one write in all its items: none of it is torn.
* Each block that anyone may write is linearizable, which is decided exactly.
* All blocks together have an order of operations that explains what was seen.
* A block with one writer, and a block that mirrors a device, has one of the values in their order,
  and never goes back. A write that the device has confirmed is visible to every later read.
* What was refused is never seen.
* While a memory is sealed, Modbus gets no other answer than that, and while it is open, never that.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from oracle.history import Outcome
from oracle.layout import Kind
from oracle.precedence import Precedence
from oracle.registers import Cluster, conflicts, is_visible
from oracle.sequences import START, Sight, Step, deviations, places_of
from oracle.violation import Violation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from oracle.history import History, Operation
    from oracle.layout import Block


def check(history: History) -> list[Violation]:
    """All violations that were found; one is enough to show that a promise was broken."""
    return _Judgement(history).violations


class _Judgement:
    def __init__(self, history: History) -> None:
        self._history = history
        self._writes: dict[Block, list[tuple[int, Operation]]] = {}
        self._refused: dict[tuple[Block, int], Operation] = {}
        self._sights: dict[Block, list[Sight]] = {block: [] for block in history.layout.blocks}
        self._clusters: dict[Block, list[Cluster]] = {}
        self.violations: list[Violation] = []
        self._gather()
        for block in history.layout.blocks:
            self.violations += {
                Kind.SHARED: self._shared,
                Kind.OWNED: self._owned,
                Kind.MIRRORED: self._mirrored,
                Kind.DEVICE: self._mirrored,
                Kind.GATE: self._gate,
            }[block.kind](block)
        self.violations += self._together()

    def _gather(self) -> None:
        """Sorts what was written and seen by blocks."""
        for operation in self._history.operations:
            for block, write_id in operation.writes:
                if is_visible(operation):
                    self._writes.setdefault(block, []).append((write_id, operation))
                else:
                    self._refused[block, write_id] = operation
            written = dict(operation.writes) if operation.writes else {}
            for block, found in self._history.decoded(operation):
                if found is None:
                    text = f"{block.name}: a read has parts of several writes"
                    self.violations.append(Violation("torn", text, (operation,)))
                elif written.get(block, found) != found:
                    text = f"{block.name}: {found} was read by the request that had written another"
                    self.violations.append(Violation("own", text, (operation,)))
                else:
                    self._sights[block].append(Sight(operation, found))

    def _initial(self, block: Block) -> int:
        return self._history.initial.get(block, 0)

    # Blocks that anyone may write

    def _shared(self, block: Block) -> Iterator[Violation]:
        clusters = {self._initial(block): Cluster(self._initial(block), None)}
        for write_id, operation in self._writes.get(block, []):
            if write_id in clusters:
                raise AssertionError(f"{block.name}: two writes have the id {write_id}")
            clusters[write_id] = Cluster(write_id, operation)
        for sight in self._sights[block]:
            cluster = clusters.get(sight.value)
            if cluster is None:
                yield self._invented(block, sight)
            elif sight.operation is not cluster.write:
                cluster.reads.append(sight.operation)
        self._clusters[block] = list(clusters.values())

    def _invented(self, block: Block, sight: Sight) -> Violation:
        refused = self._refused.get((block, sight.value))
        if refused is not None:
            text = f"{block.name}: {sight.value} was read, whose write was refused"
            return Violation("refused", text, (refused, sight.operation))
        text = f"{block.name}: {sight.value} was read, which nobody wrote"
        return Violation("invented", text, (sight.operation,))

    def _together(self) -> Iterator[Violation]:
        """The order of each block, and of all of them."""
        unseen = self._unseen()
        sound = []
        for block, all_clusters in self._clusters.items():
            clusters = [each for each in all_clusters if each.write not in unseen]
            for cluster in clusters:
                cluster.settle()
            found = list(conflicts(block, clusters))
            yield from found
            if not found:
                sound.append(clusters)
        operations = [each for each in self._history.operations if each not in unseen]
        order = Precedence(operations)
        for clusters in sound:
            order.add(clusters)
        cycle = order.cycle()
        if cycle is not None:
            yield cycle

    def _unseen(self) -> set[Operation | None]:
        """Writes of which nobody knows whether they have happened, and that nobody has seen."""
        unknown: set[Operation | None] = {
            each for each in self._history.operations if each.outcome is Outcome.UNKNOWN
        }
        for clusters in self._clusters.values():
            unknown -= {cluster.write for cluster in clusters if cluster.reads}
        return unknown

    # Blocks with one writer

    def _owned(self, block: Block) -> Iterator[Violation]:
        steps, lost = [Step(self._initial(block), START, START)], math.inf
        for value, operation in sorted(
            self._writes.get(block, []), key=lambda write: write[1].begin
        ):
            if operation.begin < steps[-1].end:
                raise AssertionError(f"{block.name}: {operation} overlaps the write before it")
            if operation.outcome is Outcome.UNKNOWN:
                # It may still come, after any later write.
                lost = operation.begin
                break
            steps.append(Step(value, operation.begin, operation.end))
        sights = [each for each in self._sights[block] if each.operation.end < lost]
        yield from deviations(block, steps, sights)

    # Mirrors of a device

    def _mirrored(self, block: Block) -> Iterator[Violation]:
        versions = self._history.versions.get(block, [])
        is_mirror = block.kind is Kind.MIRRORED
        ends = [math.inf if is_mirror else version.begin for version in versions]
        places: dict[int, list[int]] = {}
        for place, version in enumerate(versions):
            places.setdefault(version.id, []).append(place)
        for write_id, operation in self._writes.get(block, []):
            if operation.outcome is not Outcome.DONE:
                continue
            during = [
                place
                for place in places.get(write_id, [])
                if operation.begin <= versions[place].begin <= operation.end
            ]
            if during:
                ends[during[0]] = min(ends[during[0]], operation.end)
            else:
                text = f"{block.name}: {write_id} was confirmed, and the device did not take it"
                yield Violation("lost", text, (operation,))
        for (refused, write_id), operation in self._refused.items():
            if refused is block and write_id in places:
                text = f"{block.name}: {write_id} was refused, and the device took it"
                yield Violation("refused", text, (operation,))
        steps = [Step(self._initial(block), START, START)]
        steps += [Step(each.id, each.begin, end) for each, end in zip(versions, ends, strict=True)]
        yield from deviations(block, steps, self._sights[block])

    # The seal

    def _gate(self, block: Block) -> Iterator[Violation]:
        """The ids of a gate count its changes; readers see only whether it is open."""
        writes = sorted(self._writes.get(block, []), key=lambda write: write[0])
        first = self._initial(block)
        steps = [Step(first & 1, START, START)]
        clusters = [Cluster(first, None)]
        for write_id, operation in writes:
            steps.append(Step(write_id & 1, operation.begin, operation.end))
            clusters.append(Cluster(write_id, operation))
        sights = self._sights[block] + [
            Sight(operation, int(operation.is_open))
            for operation in self._history.operations
            if operation.is_open is not None
        ]
        yield from deviations(block, steps, sights)
        for sight in sights:
            places = places_of(steps, sight)
            if len(places) == 1 and sight.operation is not clusters[places[0]].write:
                clusters[places[0]].reads.append(sight.operation)
        self._clusters[block] = clusters
