"""Faults that are planted into a history, to show that the checker finds them.

Each function returns copies of a history with one fault each, that no order of operations can
explain. The conditions for that are written here once more, without the checker.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from typing import TYPE_CHECKING, NamedTuple

from oracle.history import History, Operation, Outcome, Reading
from oracle.layout import Block, Form, Kind

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Iterator


class Seen(NamedTuple):
    """An operation, and the id that it has read from a block."""

    operation: Operation
    id: int


class Evidence:
    """A history, sorted for those who plant faults."""

    def __init__(self, history: History, chance: random.Random) -> None:
        self.history = history
        self.chance = chance
        self.writes: dict[Block, dict[int, Operation]] = {}
        """By their ids; only the last one of each value of an owned block."""
        self.writers: dict[Block, list[Operation]] = {}
        self.refused: dict[Block, list[int]] = {}
        self.seen: dict[Block, list[Seen]] = {}
        for operation in history.operations:
            for block, write_id in operation.writes:
                if operation.outcome is Outcome.REFUSED:
                    self.refused.setdefault(block, []).append(write_id)
                else:
                    self.writes.setdefault(block, {})[write_id] = operation
                    self.writers.setdefault(block, []).append(operation)
            for block, found in history.decoded(operation):
                assert found is not None
                self.seen.setdefault(block, []).append(Seen(operation, found))

    def shuffled(self, *kinds: Kind) -> Iterator[tuple[Block, Seen]]:
        """What was read of blocks of these kinds, in any order."""
        found = [
            (block, seen)
            for block, all_seen in self.seen.items()
            if block.kind in kinds
            for seen in all_seen
        ]
        self.chance.shuffle(found)
        return iter(found)

    def ended(self, block: Block, before: float) -> list[tuple[int, Operation]]:
        """Writes of a block that ended before a time, by their end."""
        done = sorted(
            ((write_id, write) for write_id, write in self.writes.get(block, {}).items()),
            key=lambda each: each[1].end,
        )
        return done[: bisect.bisect_left(done, before, key=lambda each: each[1].end)]

    def replaced(self, *changes: tuple[Operation, Block, int]) -> History:
        """A copy in which these operations have read these ids."""
        history = self.history
        for operation, block, write_id in changes:
            items = block.encode(write_id)
            history = self.with_items(operation, block, items, history)
        return history

    def with_items(
        self, operation: Operation, block: Block, items: list[int], history: History | None = None
    ) -> History:
        """A copy in which an operation has read these items of a block."""
        history = history or self.history
        readings = []
        for reading in operation.readings:
            values = list(reading.values)
            for inside, offset in history.layout.inside(reading.range):
                if inside is block:
                    values[offset : offset + block.count] = items
            readings.append(Reading(reading.range, tuple(values)))
        return self.changed(operation, history, readings=tuple(readings))

    def changed(
        self, operation: Operation, history: History | None = None, **fields: object
    ) -> History:
        history = history or self.history
        new = dataclasses.replace(operation, **fields)  # type: ignore[arg-type]
        operations = [new if each is operation else each for each in history.operations]
        return dataclasses.replace(history, operations=operations)


def stale_reads(evidence: Evidence) -> Iterator[History]:
    """A read has a value that another write had replaced before the read began."""
    for block, seen in evidence.shuffled(Kind.SHARED):
        before = evidence.ended(block, seen.operation.begin)
        if len(before) < 2:
            continue
        _, last = before[-1]
        older = [write_id for write_id, write in before if write.end < last.begin]
        if older and seen.operation is not last:
            yield evidence.replaced((seen.operation, block, evidence.chance.choice(older)))


def early_reads(evidence: Evidence) -> Iterator[History]:
    """A read has a value whose write began after the read had ended."""
    for block, seen in evidence.shuffled(Kind.SHARED):
        later = [
            write_id
            for write_id, write in evidence.writes.get(block, {}).items()
            if write.begin > seen.operation.end
        ]
        if later and block not in dict(seen.operation.writes):
            yield evidence.replaced((seen.operation, block, evidence.chance.choice(later)))


def torn_reads(evidence: Evidence) -> Iterator[History]:
    """A read has the first items of one write, and the last ones of another."""
    for block, seen in evidence.shuffled(Kind.SHARED, Kind.MIRRORED):
        others = [write_id for write_id in evidence.writes.get(block, {}) if write_id != seen.id]
        if block.count < 3 or not others or not seen.id:
            continue
        here, there = block.encode(seen.id), block.encode(evidence.chance.choice(others))
        at = evidence.chance.randrange(1, block.count)
        mixed = here[:at] + there[at:]
        if mixed not in (here, there):
            yield evidence.with_items(seen.operation, block, mixed)


def lost_writes(evidence: Evidence) -> Iterator[History]:
    """A write was confirmed, and those who read it later have what was there before."""
    for block, seen in evidence.shuffled(Kind.SHARED):
        write = evidence.writes.get(block, {}).get(seen.id)
        if write is None or write.end >= seen.operation.begin or write is seen.operation:
            continue
        before = evidence.ended(block, write.begin)
        readers = [each.operation for each in evidence.seen[block] if each.id == seen.id]
        if before and write not in readers:
            yield evidence.replaced(*((reader, block, before[-1][0]) for reader in readers))


def swapped_reads(evidence: Evidence) -> Iterator[History]:
    """Two reads, one after the other, have each other's values."""
    for block, late in evidence.shuffled(Kind.SHARED):
        writes = evidence.writes.get(block, {})
        write = writes.get(late.id)
        if write is None or write is late.operation:
            continue
        early = [
            each
            for each in evidence.seen[block]
            if each.operation.end < write.begin
            and each.id in writes
            # What the early read had was written before, by another write.
            and writes[each.id].end < write.begin
            and block not in dict(each.operation.writes)
        ]
        if early:
            other = evidence.chance.choice(early)
            swap = ((late.operation, block, other.id), (other.operation, block, late.id))
            yield evidence.replaced(*swap)


def invented_values(evidence: Evidence) -> Iterator[History]:
    """A read has a value that nobody wrote."""
    for block, seen in evidence.shuffled(Kind.SHARED, Kind.MIRRORED, Kind.DEVICE):
        written = {*evidence.writes.get(block, {}), *evidence.refused.get(block, [])}
        version_ids = {version.id for version in evidence.history.versions.get(block, [])}
        strange = max(written | version_ids, default=0) + 1000
        if block not in dict(seen.operation.writes):
            yield evidence.replaced((seen.operation, block, strange))


def refused_values(evidence: Evidence) -> Iterator[History]:
    """A read has the value of a write that was refused, or cut off before it was complete."""
    for block, seen in evidence.shuffled(Kind.SHARED):
        refused = evidence.refused.get(block)
        if refused and block not in dict(seen.operation.writes):
            yield evidence.replaced((seen.operation, block, evidence.chance.choice(refused)))


def repeated_writes(evidence: Evidence) -> Iterator[History]:
    """A write without a reply takes effect twice: its value comes back after another one."""
    for block, seen in evidence.shuffled(Kind.SHARED):
        write = evidence.writes.get(block, {}).get(seen.id)
        if write is None or write.outcome is not Outcome.UNKNOWN:
            continue
        between = [
            other
            for _, other in evidence.ended(block, float("inf"))
            if other.begin > seen.operation.end and other.outcome is Outcome.DONE
        ]
        later = [
            each.operation
            for each in evidence.seen[block]
            if between and each.operation.begin > between[0].end
        ]
        if later:
            yield evidence.replaced((evidence.chance.choice(later), block, seen.id))


def half_writes(evidence: Evidence) -> Iterator[History]:
    """A write of two blocks is seen in one of them only, by a read that runs beside it."""
    for block, seen in evidence.shuffled(Kind.SHARED):
        write = evidence.writes.get(block, {}).get(seen.id)
        if write is None or write is seen.operation or seen.operation.begin > write.end:
            continue
        read = dict(evidence.history.decoded(seen.operation))
        for other, write_id in write.writes:
            before = evidence.ended(other, write.begin)
            if other is not block and read.get(other) == write_id and before:
                yield evidence.replaced((seen.operation, other, before[-1][0]))


def crossed_reads(evidence: Evidence) -> Iterator[History]:
    """Of two blocks that a read has at once, one is older than a write that the other one shows."""
    for block, seen in evidence.shuffled(Kind.SHARED):
        write = evidence.writes.get(block, {}).get(seen.id)
        if write is None or block in dict(seen.operation.writes):
            continue
        for other, write_id in evidence.history.decoded(seen.operation):
            if other is block or other.kind is not Kind.SHARED:
                continue
            # `newest` was there before `write` began, and `older` before `newest` began.
            done = evidence.ended(other, write.begin)
            newest = done[-1] if done else None
            if newest is None or write_id == newest[0] or other in dict(seen.operation.writes):
                continue
            older = evidence.ended(other, newest[1].begin)
            if older:
                yield evidence.replaced((seen.operation, other, older[-1][0]))


def mirrors_that_go_back(evidence: Evidence) -> Iterator[History]:
    """A mirror has a value that is older than one that was read before."""
    for block, seen in evidence.shuffled(Kind.MIRRORED):
        places = {each.id: at for at, each in enumerate(evidence.history.versions[block])}
        known = [
            places[each.id]
            for each in evidence.seen[block]
            if each.operation.end < seen.operation.begin and each.id in places
        ]
        older = [write_id for write_id, at in places.items() if known and at < max(known)]
        if older:
            yield evidence.replaced((seen.operation, block, evidence.chance.choice(older)))


def mirrors_of_the_future(evidence: Evidence) -> Iterator[History]:
    """A mirror has a value before the device had it."""
    for block, seen in evidence.shuffled(Kind.MIRRORED, Kind.DEVICE):
        versions = evidence.history.versions[block]
        later = [each.id for each in versions if each.begin > seen.operation.end]
        before = {each.id for each in versions if each.begin <= seen.operation.end}
        if later and later[0] not in before:
            yield evidence.replaced((seen.operation, block, evidence.chance.choice(later)))


def unseen_confirmed_writes(evidence: Evidence) -> Iterator[History]:
    """The device has confirmed a write, and a later read of the mirror has the value before."""
    for block, seen in evidence.shuffled(Kind.MIRRORED, Kind.DEVICE):
        places = {each.id: at for at, each in enumerate(evidence.history.versions[block])}
        confirmed = [
            places[write_id]
            for write_id, write in evidence.ended(block, seen.operation.begin)
            if write.outcome is Outcome.DONE
        ]
        older = [write_id for write_id, at in places.items() if confirmed and at < max(confirmed)]
        if older:
            yield evidence.replaced((seen.operation, block, evidence.chance.choice(older)))


def untaken_writes(evidence: Evidence) -> Iterator[History]:
    """A client has the confirmation of a write that the device did not take."""
    for block in evidence.history.layout.blocks:
        if block.kind is not Kind.MIRRORED:
            continue
        done = [
            write_id
            for write_id, write in evidence.writes.get(block, {}).items()
            if write.outcome is Outcome.DONE
        ]
        for write_id in done:
            versions = {
                at: [each for each in its if at is not block or each.id != write_id]
                for at, its in evidence.history.versions.items()
            }
            yield dataclasses.replace(evidence.history, versions=versions)


def wrong_values_of_owners(evidence: Evidence) -> Iterator[History]:
    """A read beside which nobody writes has another value than the last one that was written."""
    for block, seen in evidence.shuffled(Kind.OWNED):
        is_alone = not any(
            write.begin <= seen.operation.end and write.end >= seen.operation.begin
            for write in evidence.writers.get(block, [])
        )
        if is_alone:
            flip = 0x0100 if block.form is Form.HIGH_BYTE else 1
            item = next(
                reading.values[offset]
                for reading in seen.operation.readings
                for inside, offset in evidence.history.layout.inside(reading.range)
                if inside is block
            )
            yield evidence.with_items(seen.operation, block, [item ^ flip])


def wrong_answers_of_a_seal(evidence: Evidence) -> Iterator[History]:
    """A client got an answer while the memory was sealed, or a refusal while it was open."""
    [gate] = [block for block in evidence.history.layout.blocks if block.kind is Kind.GATE]
    turns = sorted(evidence.writes.get(gate, {}).items())
    spans = [
        (write.end, following.begin) for (_, write), (_, following) in itertools.pairwise(turns)
    ]
    found = [
        each
        for each in evidence.history.operations
        if each.is_open is not None
        and any(start < each.begin and each.end < end for start, end in spans)
    ]
    for is_open in (True, False):
        its = [each for each in found if each.is_open is is_open]
        for operation in evidence.chance.sample(its, min(len(its), 5)):
            yield evidence.changed(operation, is_open=not is_open)


FAULTS: dict[str, Callable[[Evidence], Iterator[History]]] = {
    function.__name__: function
    for function in (
        stale_reads,
        early_reads,
        torn_reads,
        lost_writes,
        swapped_reads,
        invented_values,
        refused_values,
        repeated_writes,
        half_writes,
        crossed_reads,
        mirrors_that_go_back,
        mirrors_of_the_future,
        unseen_confirmed_writes,
        untaken_writes,
        wrong_values_of_owners,
        wrong_answers_of_a_seal,
    )
}
