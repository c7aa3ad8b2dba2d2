"""What clients ask: which blocks they write together, and which ranges they read."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from oracle.history import Write
from oracle.layout import Block, Kind, Range
from oracle.plant import (
    ANNEX,
    BLOCKS,
    BYTES,
    DEVICE,
    DEVICE_AT,
    FLAGS,
    MIRROR_AT,
    MIRRORED_COILS,
    MIRRORED_REGISTERS,
    NAMED,
    PARTS,
    PLANT,
)
from oracle.requests import Request

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

    from oracle.faces import Traits
    from oracle.history import Ids

MAX_READ = {"coils": 2000, "discrete_inputs": 2000}
MAX_REGISTERS_READ = 125
MAX_REGISTERS_WRITTEN = 121
"""That of function 23, which is the smallest."""


def _groups(*names: str) -> list[list[Block]]:
    """All runs of these blocks, which lie next to each other."""
    blocks = [NAMED[name] for name in names]
    places = itertools.combinations(range(len(blocks) + 1), 2)
    return [blocks[start:end] for start, end in places]


GROUPS = [
    *_groups("h1", "h2", "h8", "h61"),
    *_groups("c32", "c48"),
    *_groups("d32"),
    *_groups("i2", "i30"),
    *_groups("i300"),
    *_groups("a1", "a10"),
    *_groups("ai4"),
    *_groups("mr1", "mr8", "mr9", "mr9 next"),
    # Functions 6 and 22, again.
    *_groups("mr1"),
    *_groups("mr1"),
    *_groups("mc32"),
    *_groups("device mr1", "device mr8", "device mr9", "device mr9 next"),
    *_groups("device mc32"),
]
"""Blocks that one request can write, which is not a batch."""

RANGES = [
    Range(PLANT, "holding_registers", 0, 73),
    Range(PLANT, "holding_registers", 0, 3),
    Range(PLANT, "holding_registers", 1, 10),
    Range(PLANT, "holding_registers", 72, 1),
    Range(PLANT, "holding_registers", MIRROR_AT, MIRRORED_REGISTERS),
    Range(PLANT, "holding_registers", MIRROR_AT, 9),
    Range(PLANT, "holding_registers", 0, MIRROR_AT + MIRRORED_REGISTERS),
    Range(PLANT, "coils", 0, 90),
    Range(PLANT, "coils", 83, 2),
    Range(PLANT, "coils", MIRROR_AT, MIRRORED_COILS),
    Range(PLANT, "coils", 0, MIRROR_AT + MIRRORED_COILS),
    Range(PLANT, "input_registers", 0, 32),
    Range(PLANT, "input_registers", 0, 340),
    Range(PLANT, "discrete_inputs", 0, 40),
    Range(ANNEX, "holding_registers", 0, 11),
    Range(ANNEX, "holding_registers", 0, 1),
    Range(ANNEX, "input_registers", 0, 4),
    Range(DEVICE, "holding_registers", DEVICE_AT, MIRRORED_REGISTERS),
    Range(DEVICE, "coils", DEVICE_AT, MIRRORED_COILS),
]

EVERYTHING = [
    Range(PLANT, "holding_registers", 0, MIRROR_AT + MIRRORED_REGISTERS),
    Range(PLANT, "coils", 0, MIRROR_AT + MIRRORED_COILS),
    Range(PLANT, "input_registers", 0, 340),
    Range(PLANT, "discrete_inputs", 0, 40),
    Range(ANNEX, "holding_registers", 0, 11),
    Range(ANNEX, "input_registers", 0, 4),
]
"""All that the memories have."""

PASSED = (Kind.MIRRORED, Kind.DEVICE)
SHARE_OF_DEVICE = 0.2
"""How many of the writes go to the device. It takes one after another."""

TWIN = {part.device: part.mirror for part in PARTS}
"""A block of the device has the ids of the block that it is read into."""


class Draws:
    """The requests of one client: the same ones for each seed, but for the ids."""

    def __init__(self, face: type[Traits], ids: Ids, chance: random.Random) -> None:
        self._face = face
        self._ids = ids
        self._chance = chance
        can = [group for group in GROUPS if self._writes(group)]
        self._passed = [group for group in can if group[0].kind in PASSED]
        self._own = [group for group in can if group[0].kind not in PASSED]
        self._ranges = [each for each in RANGES if self._reads(each)]
        self._any = [
            block for block in BLOCKS if block.kind is Kind.SHARED and block.memory in face.memories
        ]

    def _writes(self, group: Sequence[Block]) -> bool:
        count = sum(block.count for block in group)
        fits = group[0].is_of_bits or count <= MAX_REGISTERS_WRITTEN or not self._face.is_modbus
        return fits and group[0].area in self._face.areas and group[0].memory in self._face.memories

    def _reads(self, of: Range) -> bool:
        fits = of.size <= MAX_READ.get(of.area, MAX_REGISTERS_READ) or not self._face.is_modbus
        return self._face.can_read and fits and of.memory in self._face.memories

    def draw(self) -> Request:
        """Any request that the face can carry out."""
        if self._face.can_read and self._chance.random() < 0.5:
            return self._read()
        if self._face.can_batch and self._chance.random() < 0.4:
            return self._batch()
        return self.write()

    def _read(self) -> Request:
        many = self._face.can_batch and not self._face.spans_memories
        if many and self._chance.random() < 0.5:
            of = [each for each in EVERYTHING if each.memory == PLANT]
            return Request(reads=tuple(self._chance.sample(of, self._chance.randint(2, len(of)))))
        return Request(reads=(self._chance.choice(self._ranges),))

    def _batch(self) -> Request:
        blocks = self._any
        if not self._face.spans_memories:
            blocks = [block for block in blocks if block.memory == PLANT]
        return Request(self._drawn(self._chance.sample(blocks, self._chance.randint(2, 4))))

    def write(self) -> Request:
        is_passed = bool(self._passed) and self._chance.random() < SHARE_OF_DEVICE
        group = self._chance.choice(self._passed if is_passed else self._own)
        writes = self._drawn(group)
        if not self._face.is_modbus:
            return Request(writes)
        first = group[0]
        if len(group) == first.count == 1 and self._chance.random() < 0.7:
            is_mask = self._chance.random() < 0.5
            return Request(writes, is_mask=is_mask, is_single=not is_mask)
        if first.area == "holding_registers" and self._chance.random() < 0.3:
            return Request(writes, (self._exchanged(first),))
        return Request(writes)

    def write_own(self) -> Request:
        """A write that no device can refuse."""
        return Request(self._drawn(self._chance.choice(self._own)))

    def _exchanged(self, first: Block) -> Range:
        """A range that function 23 reads. In a mirror, it is in the same read of the device."""
        found = [
            each
            for each in self._ranges
            if (each.memory, each.area) == (first.memory, first.area)
            and (each.address >= MIRROR_AT) == (first.kind in PASSED)
        ]
        return self._chance.choice(found)

    def _drawn(self, blocks: Sequence[Block]) -> tuple[Write, ...]:
        return tuple(Write(block, self._ids.draw(TWIN.get(block, block))) for block in blocks)


class OwnerDraws:
    """The requests of the one client that writes some owned blocks."""

    def __init__(self, blocks: Sequence[Block], chance: random.Random) -> None:
        self._blocks = blocks
        self._chance = chance
        self._count = 0

    def draw(self) -> Request:
        block = self._chance.choice(self._blocks)
        if self._chance.random() < 0.4:
            return Request(reads=(Range(block.memory, block.area, block.address, block.count),))
        self._count += 1
        if block.is_of_bits:
            return Request((Write(block, self._chance.randint(0, 1)),), is_single=True)
        return Request((Write(block, self._count % 256),), is_mask=True)


OWNERS = [(FLAGS[0], BYTES[0]), (FLAGS[1], BYTES[1])]
"""Who owns what."""
