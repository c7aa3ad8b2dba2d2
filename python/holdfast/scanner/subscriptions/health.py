"""The health of a device, derived from its polls."""

from __future__ import annotations

import time
from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.polling.faults import NO_CONNECTION, UNREACHABLE, fault_text, is_exception
from holdfast.protocol import GATEWAY_FAILURES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.scanner.messages.types import State
    from holdfast.types import PolledBlock

Block = TypeVar("Block", bound=tuple[Any, ...])
"""A tuple that begins with area, address and count."""

TOLERATED_FAILURES = 1
"""Consecutive scans without a response that leave a device online: at the second it is offline."""


@dataclass(slots=True)
class Health:
    """The state of a device, its failures and its last errors."""

    state: State = "connecting"
    since: float = field(default_factory=time.time)
    """When the state began. All times are seconds since 1970."""
    failures: int = 0
    error: str | None = None
    last_answer: float | None = None
    last_error: str | None = None
    """The last error, also after a recovery."""
    last_error_at: float | None = None
    scans: int = 0
    blocks: list[PolledBlock] = field(default_factory=list)
    """Each block with the result of the last scan that read it."""

    def disable(self) -> None:
        """Records that the device is not polled any more."""
        self.state, self.since, self.error = "offline", time.time(), "the scanner is disabled"
        self.blocks = []

    def judge(self, blocks: list[PolledBlock]) -> bool:
        """Updates the health from a poll. Returns whether it must be published.

        It must when the state changes, and when an online device returns another exception. A
        single missing response does not make an online device offline.
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
            unreached = any(fault in (NO_CONNECTION, UNREACHABLE) for fault, _ in faults)
            if self.state != "online" or self.failures > TOLERATED_FAILURES or unreached:
                self.state = "offline"
        if self.state != before[0]:  # At the time of the response, not of this call.
            self.since = blocks[-1][5]
        self.error = None
        if faults:
            fault, self.last_error_at = faults[0]
            self.error = self.last_error = fault_text(fault)
        # After a timeout, the rest of a scan is skipped: older results of its blocks stay.
        cut_short = not all(is_exception(fault) for fault, _ in faults)
        self.blocks = [*without_overlap(self.blocks, blocks), *blocks] if cut_short else blocks
        return before != (self.state, self.error if self.state == "online" else None)


def without_overlap(blocks: Iterable[Block], others: Iterable[PolledBlock]) -> list[Block]:
    """Returns the blocks that overlap none of `others`, which must not overlap each other."""
    places = sorted(block[:3] for block in others)

    def is_apart(block: Block) -> bool:
        area, address, count = block[:3]
        at = bisect_left(places, (area, address + count, 0)) - 1
        before = places[at] if at >= 0 else None
        return before is None or before[0] != area or before[1] + before[2] <= address

    return [block for block in blocks if is_apart(block)]


def _answered(fault: int) -> bool:
    return is_exception(fault) and fault not in GATEWAY_FAILURES
