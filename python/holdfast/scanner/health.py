"""How a device does, as its polls tell."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.scanner.messages import State
    from holdfast.scanner.polling import Block

TRANSPORT = 0x8000
"""From here on faults are none of the device's: the request or its reply got lost."""

UNREACHED = (0x0A, 0x0B)
"""What a gateway answers that does not reach the device."""

NO_CONNECTION = 0x8002

FORGIVEN = 1
"""Scans in a row that a device may leave unanswered before it is offline."""

FAULTS = {
    0x01: "exception 01 (Illegal Function)",
    0x02: "exception 02 (Illegal Data Address)",
    0x03: "exception 03 (Illegal Data Value)",
    0x04: "exception 04 (Server Device Failure)",
    0x05: "exception 05 (Acknowledge)",
    0x06: "exception 06 (Server Device Busy)",
    0x08: "exception 08 (Memory Parity Error)",
    0x0A: "exception 0A (Gateway Path Unavailable)",
    0x0B: "exception 0B (Gateway Target Device Failed to Respond)",
    0x8001: "no reply in time",
    NO_CONNECTION: "no connection",
    0x8003: "the connection was lost",
    0x8004: "an invalid reply",
}

UNWRITTEN = (0x01, 0x02, 0x03, 0x06, 0x0A, NO_CONNECTION)
"""Faults of a write that never came to be carried out."""


def described(fault: int) -> str:
    """A fault in words."""
    return FAULTS.get(fault, f"exception {fault:02X}")


def is_unwritten(fault: int) -> bool:
    """Whether a write that failed has certainly changed nothing."""
    return fault in UNWRITTEN


@dataclass
class Health:
    """State, failures since the last answer, and why."""

    state: State = "connecting"
    failures: int = 0
    error: str | None = None
    last_answer: float | None = None
    """Seconds since 1970."""
    scans: int = 0
    blocks: list[Block] = field(default_factory=list)
    """Those of the last scan."""

    def judge(self, blocks: list[Block]) -> bool:
        """Takes note of a poll; whether that is worth telling.

        It is when the state changes, and when a device that answers refuses something new. One
        reply that is missing does not make a device offline that was online.
        """
        before = (self.state, self.error if self.state == "online" else None)
        self.scans += 1
        faults = [fault for *_, fault, _ in blocks if fault]
        answers = [time for *_, fault, time in blocks if not fault or _answered(fault)]
        if answers:
            self.state, self.failures, self.last_answer = "online", 0, answers[-1]
        else:
            self.failures += 1
            if self.state != "online" or self.failures > FORGIVEN or NO_CONNECTION in faults:
                self.state = "offline"
        self.error = described(faults[0]) if faults else None
        self.blocks = blocks
        return before != (self.state, self.error if self.state == "online" else None)


def _answered(fault: int) -> bool:
    return fault < TRANSPORT and fault not in UNREACHED
