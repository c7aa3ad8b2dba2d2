"""What the cells of a memory mean to the oracle: blocks, and the write ids that they hold.

A block is always written as a whole. What is written is made from a write id that the block never
had before, so that what a reader sees names the write that it comes from, or is torn.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.types import Area

WORD_BITS = 16
MAX_WORD = 0xFFFF


class Form(Enum):
    """How a block holds an id."""

    WORDS = "words"
    """All words are made of the id. One word holds an id of 16 bits, several one of 32."""
    PLAIN = "plain"
    """One item, with the id itself."""
    LOW_BYTE = "low byte"
    HIGH_BYTE = "high byte"


class Kind(Enum):
    """Who writes a block, which decides how it is judged."""

    SHARED = "shared"
    """Anyone may write it. Each id occurs once."""
    OWNED = "owned"
    """One writer writes it, one write after another. Values may repeat."""
    MIRRORED = "mirrored"
    """It is read from a device, and the device knows the order of all its values."""
    DEVICE = "device"
    """It is the device itself, behind a route."""
    GATE = "gate"
    """The gate bit of a seal, which one writer opens and closes. Its ids count the changes: it is
    open after odd ones."""


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive items of one area."""

    name: str
    memory: str
    area: Area
    address: int
    count: int
    kind: Kind = Kind.SHARED
    form: Form = Form.WORDS

    @property
    def is_of_bits(self) -> bool:
        return self.area in ("coils", "discrete_inputs")

    def is_followed_by(self, other: Block) -> bool:
        """Whether the other block begins where this one ends."""
        end = (self.memory, self.area, self.address + self.count)
        return end == (other.memory, other.area, other.address)

    @property
    def max_id(self) -> int:
        words = self.count // WORD_BITS if self.is_of_bits else self.count
        return MAX_WORD if words == 1 else 0xFFFF_FFFF

    def encode(self, write_id: int) -> list[int]:
        """The items of a write. Forms of bytes have no items of their own."""
        if self.kind is Kind.GATE:
            return [write_id & 1]
        if self.form is Form.PLAIN:
            return [write_id]
        words = _words(write_id, self.count // WORD_BITS if self.is_of_bits else self.count)
        if not self.is_of_bits:
            return words
        return [word >> bit & 1 for word in words for bit in range(WORD_BITS)]

    @lru_cache(maxsize=1 << 16)  # noqa: B019 - blocks live as long as the program
    def decode(self, items: tuple[int, ...]) -> int | None:
        """The id that some items hold, or `None` if they are parts of several writes."""
        if self.form is Form.PLAIN or self.kind is Kind.GATE:
            return items[0]
        if self.form is Form.LOW_BYTE:
            return items[0] & 0xFF
        if self.form is Form.HIGH_BYTE:
            return items[0] >> 8
        words = _gathered(items) if self.is_of_bits else list(items)
        if not any(words):
            return 0
        found = words[0]
        if len(words) > 1:
            found |= ((words[1] - 3 * words[0] - _salt(1)) & MAX_WORD) << WORD_BITS
        return found if _words(found, len(words)) == words else None


def _salt(index: int) -> int:
    """Makes the words of a block different from each other."""
    return index * 0x2F1D & MAX_WORD


def _words(write_id: int, count: int) -> list[int]:
    """Words that all change from one id to the next, so that no mixture of two writes looks whole.

    Id 0 is what a memory has before the first write.
    """
    if write_id == 0:
        return [0] * count
    low, high = write_id & MAX_WORD, write_id >> WORD_BITS
    return [
        (high + 3 * low if index % 2 else low) + _salt(index) & MAX_WORD for index in range(count)
    ]


def _gathered(bits: Sequence[int]) -> list[int]:
    starts = range(0, len(bits), WORD_BITS)
    return [sum(bit << at for at, bit in enumerate(bits[start : start + 16])) for start in starts]


class Range(NamedTuple):
    """A range of a memory."""

    memory: str
    area: Area
    address: int
    size: int


class Layout:
    """All blocks."""

    def __init__(self, blocks: Iterable[Block]) -> None:
        self.blocks = list(blocks)
        self._known: dict[Range, list[tuple[Block, int]]] = {}

    def inside(self, of: Range) -> list[tuple[Block, int]]:
        """The blocks that are wholly inside a range, with their offsets."""
        if of not in self._known:
            self._known[of] = [
                (block, block.address - of.address)
                for block in self.blocks
                if (block.memory, block.area) == (of.memory, of.area)
                and of.address <= block.address
                and block.address + block.count <= of.address + of.size
            ]
        return self._known[of]

    def named(self, name: str) -> Block:
        [found] = [block for block in self.blocks if block.name == name]
        return found
