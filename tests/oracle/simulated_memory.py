"""Histories of a correct memory with random delays, and the truth about small histories."""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, NamedTuple

from oracle.history import History, Operation, Outcome, Reading, Version, Write
from oracle.layout import Block, Form, Kind, Layout, Range

if TYPE_CHECKING:
    from collections.abc import Sequence

MEMORY = "m"


def layout() -> Layout:
    """Blocks of every kind, which lie next to each other."""

    def registers(name: str, address: int, count: int, **more: Kind | Form) -> Block:
        return Block(name, MEMORY, "holding_registers", address, count, **more)  # type: ignore[arg-type]

    return Layout(
        [
            registers("one", 0, 1),
            registers("two", 1, 2),
            registers("nine", 3, 9),
            registers("mirror", 20, 4, kind=Kind.MIRRORED),
            registers("low", 30, 1, kind=Kind.OWNED, form=Form.LOW_BYTE),
            registers("high", 30, 1, kind=Kind.OWNED, form=Form.HIGH_BYTE),
            Block("bits", MEMORY, "coils", 3, 32),
            Block("flag", MEMORY, "coils", 40, 1, Kind.OWNED, Form.PLAIN),
            Block("gate", MEMORY, "discrete_inputs", 0, 1, Kind.GATE),
        ]
    )


SHARED_RANGES = [
    Range(MEMORY, "holding_registers", 0, 12),
    Range(MEMORY, "holding_registers", 0, 3),
    Range(MEMORY, "holding_registers", 1, 11),
    Range(MEMORY, "coils", 0, 40),
    Range(MEMORY, "holding_registers", 0, 1),
]
OTHER_RANGES = [
    Range(MEMORY, "holding_registers", 20, 11),
    Range(MEMORY, "coils", 40, 1),
    Range(MEMORY, "discrete_inputs", 0, 1),
]


class _Plan(NamedTuple):
    """An operation before its moment has come."""

    moment: int
    begin: int
    end: int
    client: int


class SimulatedMemory:
    """Clients that do one operation after another; each takes effect at a moment of its own."""

    def __init__(self, seed: int, clients: int, count: int) -> None:
        self._chance = random.Random(seed)
        self._layout = layout()
        self._items: dict[tuple[str, int], int] = {}
        self._next = dict.fromkeys(self._layout.blocks, 0)
        self._versions: list[Version] = []
        self._device = 0
        self._operations: list[Operation] = []
        plans = [plan for client in range(clients) for plan in self._plans(client, count)]
        for plan in sorted(plans):
            self._carry_out(plan)
        mirror = self._layout.named("mirror")
        self.history = History(self._layout, self._operations, {}, {mirror: self._versions})

    def _plans(self, client: int, count: int) -> list[_Plan]:
        # The moments are all different.
        times = sorted(self._chance.sample(range(40 * count), 3 * count))
        times = [64 * time + client for time in times]
        return [
            _Plan(times[at + 1], times[at], times[at + 2], client) for at in range(0, 3 * count, 3)
        ]

    def _carry_out(self, plan: _Plan) -> None:
        {0: self._own, 1: self._seal, 2: self._mirror}.get(plan.client, self._share)(plan)

    def _own(self, plan: _Plan) -> None:
        """The writer of the flag and of both bytes."""
        name = self._chance.choice(["flag", "low", "high"])
        block = self._layout.named(name)
        self._next[block] += 1
        value = self._next[block] % (2 if name == "flag" else 256)
        at = (block.area, block.address)
        now = self._items.get(at, 0)
        changed = {
            "flag": value,
            "low": now & 0xFF00 | value,
            "high": now & 0xFF | value << 8,
        }
        self._items[at] = changed[name]
        self._record(plan, "own", (Write(block, value),))

    def _seal(self, plan: _Plan) -> None:
        """The one that opens and closes the memory, and may write at the same moment."""
        writes = []
        if self._chance.random() < 0.2:
            gate = self._layout.named("gate")
            self._next[gate] += 1
            writes.append(Write(gate, self._next[gate]))
        if not writes or self._chance.random() < 0.5:
            writes.append(self._drawn("nine"))
        self._put(writes)
        self._record(plan, "ingest", tuple(writes))

    def _mirror(self, plan: _Plan) -> None:
        """The device: it changes, its poller copies, and writes go to it."""
        mirror = self._layout.named("mirror")
        kind = self._chance.choice(["changes", "is polled", "is written"])
        if kind != "is polled":
            self._next[mirror] += 1
            self._device = self._next[mirror]
            self._versions.append(Version(self._device, plan.moment))
        if kind != "changes":
            self._put([Write(mirror, self._device)])
        if kind == "is written":
            self._record(plan, "pass", (Write(mirror, self._device),))

    def _share(self, plan: _Plan) -> None:
        """Anyone: by Modbus if the client has an even number, otherwise by a way without a seal."""
        is_modbus = plan.client % 2 == 0
        is_open = bool(self._items.get(("discrete_inputs", 0), 0))
        if is_modbus and not is_open:
            write = self._drawn("one")
            self._record(plan, "modbus", (write,), outcome=Outcome.REFUSED, is_open=False)
            return
        seen = is_open if is_modbus else None
        if self._chance.random() < 0.5:
            of = self._chance.choice(SHARED_RANGES + OTHER_RANGES)
            self._record(plan, "read", readings=(self._read(of),), is_open=seen)
            return
        names = self._chance.sample(["one", "two", "nine", "bits"], self._chance.choice([1, 1, 2]))
        writes = tuple(self._drawn(name) for name in names)
        fate = self._chance.random()
        if fate < 0.1:
            self._record(plan, "cut before", writes, outcome=Outcome.UNKNOWN)
            return
        self._put(writes)
        if fate < 0.2:
            self._record(plan, "cut after", writes, outcome=Outcome.UNKNOWN)
        elif fate < 0.4:
            of = self._chance.choice(SHARED_RANGES)
            self._record(plan, "exchange", writes, (self._read(of),), is_open=seen)
        else:
            self._record(plan, "write", writes, is_open=seen)

    def _drawn(self, name: str) -> Write:
        block = self._layout.named(name)
        self._next[block] += 1
        return Write(block, self._next[block])

    def _put(self, writes: Sequence[Write]) -> None:
        for block, write_id in writes:
            places = [(block.area, block.address + at) for at in range(block.count)]
            self._items.update(zip(places, block.encode(write_id), strict=True))

    def _read(self, of: Range) -> Reading:
        addresses = range(of.address, of.address + of.size)
        return Reading(of, tuple(self._items.get((of.area, at), 0) for at in addresses))

    def _record(
        self,
        plan: _Plan,
        name: str,
        writes: tuple[Write, ...] = (),
        readings: tuple[Reading, ...] = (),
        *,
        outcome: Outcome = Outcome.DONE,
        is_open: bool | None = None,
    ) -> None:
        end = math.inf if outcome is Outcome.UNKNOWN else plan.end
        face = f"client {plan.client}"
        made = Operation(face, name, plan.begin, end, outcome, writes, readings, is_open)
        self._operations.append(made)


def is_linearizable(history: History) -> bool:
    """The truth, by trying all orders. For very few operations on shared blocks only."""
    operations = history.operations
    tried: set[tuple[frozenset[int], tuple[tuple[str, int], ...]]] = set()

    def leads_to_the_end(left: frozenset[int], held: dict[Block, int]) -> bool:
        due = [at for at in left if operations[at].outcome is not Outcome.UNKNOWN]
        if not due:
            return True
        state = (left, tuple(sorted((block.name, found) for block, found in held.items())))
        if state in tried:
            return False
        tried.add(state)
        last_begin = min(operations[at].end for at in due)
        for at in left:
            operation = operations[at]
            if operation.begin > last_begin:
                continue
            after = held | dict(operation.writes)
            fits = all(after.get(block, 0) == found for block, found in history.decoded(operation))
            if fits and leads_to_the_end(left - {at}, after):
                return True
        return False

    return leads_to_the_end(frozenset(range(len(operations))), dict(history.initial))
