"""What all nodes of a fleet have in common."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import msgspec

from holdfast.config.scanning import PARTITIONS
from holdfast.leases import LEASE_TIMES, LeaseTimes

PROTOCOL = 1
"""The version of the buckets and messages that nodes share."""


class FleetRefused(Exception):
    """The node can't be a part of the fleet with these settings."""


@dataclass(frozen=True)
class FleetSettings:
    """The fleet that a scanner is a part of."""

    name: str
    node: str
    """The name of this scanner in the fleet; unique."""
    partitions: int = PARTITIONS
    lease_times: LeaseTimes = LEASE_TIMES
    """The same for all nodes, or two of them use a device."""
    check_interval_s: float = 5.0
    """Between looks whether changes of subscriptions still come."""


def digest(terms: bytes) -> str:
    """What a node shows of its terms."""
    return hashlib.blake2b(terms, digest_size=8).hexdigest()


class Terms(msgspec.Struct, frozen=True, kw_only=True):
    """The settings that all nodes have in common: any of them answers any request."""

    protocol: int
    partitions: int
    prefix: str
    allow: list[str]
    writes: str
    strict: bool
    defaults: str
    limits: str
    profiles: str

    def encoded(self) -> bytes:
        """How they are stored."""
        return msgspec.json.encode(self)

    def difference(self, other: Terms) -> str | None:
        """The first setting in which the other terms differ, with both values."""
        for key in self.__struct_fields__:
            own, theirs = getattr(self, key), getattr(other, key)
            if own != theirs:
                return f"{key} is {own}, and {theirs} in the fleet"
        return None
