"""The entries of a bucket of leases, and the times that all nodes agree on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec

SETTLED = "_settled"
"""The key that says that a bucket has existed for `LeaseTimes.ttl_s`: leases of a lost one of the
same name may still be used when it is made."""


@dataclass(frozen=True)
class LeaseTimes:
    """The times of leases in seconds. All nodes of a bucket must have the same."""

    ttl_s: float = 3.0
    """Without a renewal for so long, others may take a lease."""
    hold_s: float = 2.0
    """So long after the last renewal was sent, its holder stops. The rest of `ttl_s` is for what is
    still on its way to a device."""
    renewal_s: float = 1.0
    """Between renewals."""

    def __post_init__(self) -> None:
        assert 0 < self.renewal_s < self.hold_s < self.ttl_s, "each time leaves room for the next"

    @property
    def server_ttl_s(self) -> int:
        """The TTL of a key, of which servers accept only whole numbers: not before `ttl_s`."""
        return math.ceil(self.ttl_s)

    @property
    def answer_timeout_s(self) -> float:
        """The time for one answer: if it is lost, the next renewal still comes in time."""
        return 0.9 * (self.hold_s - self.renewal_s)


LEASE_TIMES = LeaseTimes()
"""The times of all leases, except in tests."""


class Holding(msgspec.Struct, frozen=True, kw_only=True):
    """The value of a lease."""

    node: str
    process: str
    """A random text of the process that holds it: a restarted node is another holder."""
    taken: int = 0
    """Milliseconds since 1970 at which the holder took it."""
    about: dict[str, Any] = {}
    """What else the holder tells of it."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A key, as it was last seen."""

    revision: int
    holding: Holding | None
    """`None` if nobody holds it."""
    seen: float
    """When this revision was first seen, on the own monotonic clock."""
    is_given_back: bool = False
    """Whether its holder has ended all uses before it deleted the key."""

    def is_live(self, now: float, times: LeaseTimes) -> bool:
        """Whether somebody may still hold it. Clocks of other machines play no part."""
        return self.holding is not None and now < self.seen + times.ttl_s


def entry(revision: int, headers: dict[str, str] | None, value: bytes, now: float) -> Entry:
    """The entry of a message of the bucket. One without a valid value is held by nobody."""
    headers = headers or {}
    if "KV-Operation" in headers or "Nats-Marker-Reason" in headers:
        given_back = headers.get("KV-Operation") == "DEL"
        return Entry(revision, None, now, is_given_back=given_back)
    try:
        return Entry(revision, msgspec.json.decode(value, type=Holding), now)
    except msgspec.DecodeError:
        return Entry(revision, None, now)
