"""Requests of the oracle, independent of a protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from oracle.layout import Form, Kind, Range

if TYPE_CHECKING:
    from collections.abc import Sequence

    from oracle.history import Outcome, Write
    from oracle.layout import Block


@dataclass(frozen=True)
class Request:
    """Ranges to read, and blocks to write, in one step."""

    writes: tuple[Write, ...] = ()
    reads: tuple[Range, ...] = ()
    is_mask: bool = False
    """Whether one register is written with function 22."""
    is_single: bool = False
    """Whether one item is written with function 5 or 6."""

    @property
    def memory(self) -> str:
        return self.writes[0].block.memory if self.writes else self.reads[0].memory

    def stretch(self) -> tuple[Range, list[int]]:
        """The range from the first to the last block that is written, and its items."""
        return stretch(self.writes)

    def mask(self) -> tuple[int, int, int]:
        """The address, the AND mask and the OR mask that write the only block, or only its byte."""
        [(block, value)] = self.writes
        if block.form is Form.LOW_BYTE:
            return block.address, 0xFF00, value
        if block.form is Form.HIGH_BYTE:
            return block.address, 0x00FF, value << 8
        return block.address, 0, block.encode(value)[0]


class Reply(NamedTuple):
    """What a face learned from a request."""

    outcome: Outcome
    values: tuple[tuple[int, ...], ...] = ()
    """The values of the ranges that were read."""
    is_open: bool | None = None


class Lost(Exception):
    """There is no reply, and there won't be one."""


class Surprise(Exception):
    """A reply that the documentation doesn't explain."""


def stretch(writes: Sequence[Write]) -> tuple[Range, list[int]]:
    first, last = writes[0].block, writes[-1].block
    start, end = first.address, last.address + last.count
    items = [0] * (end - start)
    for block, write_id in writes:
        at = block.address - start
        items[at : at + block.count] = block.encode(write_id)
    return Range(first.memory, first.area, start, end - start), items


def is_passed(blocks: Sequence[Block]) -> bool:
    """Whether a write goes to a device."""
    return any(block.kind in (Kind.MIRRORED, Kind.DEVICE) for block in blocks)
