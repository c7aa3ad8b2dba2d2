"""The entries of a bucket of leases, and the times that all nodes agree on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec

TTL = 3.0
"""Seconds without a renewal after which others may take a lease. A whole number, for the server."""

HELD = 2.0
"""Seconds after the last renewal was sent after which its holder stops. The rest of `TTL` is for
what is still on its way to a device."""

RENEWED = 1.0
"""Seconds between renewals."""


SETTLED = "_settled"
"""The key that says that a bucket has existed for `TTL`: leases of a lost one of the same name may
still be used when it is made."""


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

    def is_live(self, now: float) -> bool:
        """Whether somebody may still hold it. Clocks of other machines play no part."""
        return self.holding is not None and now < self.seen + TTL


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
