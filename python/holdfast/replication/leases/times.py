"""The times of leases: how long one is held, and when others may take it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from holdfast.runtime.standstill import STANDSTILL_S


@dataclass(frozen=True)
class LeaseTimes:
    """The times of leases in seconds. All nodes of a bucket must have the same."""

    ttl_s: float = 3.0
    """Without a renewal for so long, others may take a lease."""
    hold_s: float = STANDSTILL_S
    """So long after the last renewal was sent, its holder stops. The rest of `ttl_s` is for what is
    still on its way to a device."""
    renewal_s: float = 1.0
    """Between renewals."""

    def __post_init__(self) -> None:
        assert 0 < self.renewal_s < self.hold_s < self.ttl_s, "each time leaves room for the next"

    @property
    def settle_s(self) -> float:
        """After a lease was taken that was not given back, writes wait for so long, and the timeout
        of the device: its former holder may still use it. Polls wait only if the device has
        `release`. The same for all leases after their bucket was lost."""
        return self.ttl_s

    @property
    def unheld_s(self) -> float:
        """So long a lease may be without news and without a holder while all is well: it has ended,
        the bucket was lost, and another node needs time to take it. Then nodes are not ready."""
        return self.ttl_s + 2 * self.settle_s

    @property
    def server_ttl_s(self) -> int:
        """The TTL of a key, of which servers accept only whole numbers: not before `ttl_s`."""
        return math.ceil(self.ttl_s)

    @property
    def answer_timeout_s(self) -> float:
        """The time for one answer: if it is lost, another renewal is sent before `hold_s` is over,
        and does not wait for the next `renewal_s`."""
        return 0.9 * (self.hold_s - self.renewal_s)


LEASE_TIMES = LeaseTimes()
"""The times of all leases, except in tests."""
