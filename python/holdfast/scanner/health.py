"""How a device does, as its polls tell."""

from __future__ import annotations

import time
from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.faults import NO_CONNECTION, fault_text, is_exception
from holdfast.protocol import (
    BUSY,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    PATH_UNAVAILABLE,
    TARGET_SILENT,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.scanner.messages import State
    from holdfast.types import PolledBlock

Found = TypeVar("Found", bound=tuple[Any, ...])
"""A tuple that begins with area, address and count."""

UNREACHED = (PATH_UNAVAILABLE, TARGET_SILENT)
"""What a gateway answers that does not reach the device."""

FORGIVEN = 1
"""Scans in a row that a device may leave unanswered before it is offline."""

UNWRITTEN = (
    ILLEGAL_FUNCTION,
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    BUSY,
    PATH_UNAVAILABLE,
    NO_CONNECTION,
)
"""Faults of a write that never came to be carried out."""


def is_unwritten(fault: int) -> bool:
    """Whether a write that failed has certainly changed nothing."""
    return fault in UNWRITTEN


@dataclass
class Health:
    """State, failures since the last answer, and why."""

    state: State = "connecting"
    since: float = field(default_factory=time.time)
    """Seconds since 1970, as the other times: when the state began."""
    failures: int = 0
    error: str | None = None
    last_answer: float | None = None
    last_error: str | None = None
    """What went wrong last, though it may be well again."""
    last_error_at: float | None = None
    scans: int = 0
    blocks: list[PolledBlock] = field(default_factory=list)
    """Each as the last scan left it that came to it."""

    def judge(self, blocks: list[PolledBlock]) -> bool:
        """Takes note of a poll; whether that is worth telling.

        It is when the state changes, and when a device that answers refuses something new. One
        reply that is missing does not make a device offline that was online.
        """
        if not blocks:
            return False
        before = (self.state, self.error if self.state == "online" else None)
        self.scans += 1
        faults = [(fault, time) for *_, fault, time in blocks if fault]
        answers = [time for *_, fault, time in blocks if not fault or _answered(fault)]
        if answers:
            self.state, self.failures, self.last_answer = "online", 0, answers[-1]
        else:
            self.failures += 1
            unreached = any(fault == NO_CONNECTION for fault, _ in faults)
            if self.state != "online" or self.failures > FORGIVEN or unreached:
                self.state = "offline"
        if self.state != before[0]:
            self.since = blocks[-1][5]
        self.error = None
        if faults:
            fault, self.last_error_at = faults[0]
            self.error = self.last_error = fault_text(fault)
        cut_short = not all(is_exception(fault) for fault, _ in faults)
        self.blocks = [*beside(self.blocks, blocks), *blocks] if cut_short else blocks
        return before != (self.state, self.error if self.state == "online" else None)


def beside(blocks: Iterable[Found], others: Iterable[PolledBlock]) -> list[Found]:
    """The blocks that share nothing with others, which don't overlap each other."""
    places = sorted(block[:3] for block in others)

    def is_beside(block: Found) -> bool:
        area, address, count = block[:3]
        at = bisect_left(places, (area, address + count, 0)) - 1
        before = places[at] if at >= 0 else None
        return before is None or before[0] != area or before[1] + before[2] <= address

    return [block for block in blocks if is_beside(block)]


def _answered(fault: int) -> bool:
    return is_exception(fault) and fault not in UNREACHED
