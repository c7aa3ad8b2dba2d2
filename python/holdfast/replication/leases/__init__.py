"""Leases in a bucket of NATS JetStream: which of several nodes may use something, such as a device.

A lease is a key with a TTL. Its holder renews it, and stops by its own clock if it can't: everyone
else waits longer than that before they take it. `LeaseTimes` are these times.
"""

from __future__ import annotations

from holdfast.replication.leases.bucket import (
    Entry,
    Holding,
    KeyBucket,
    LeaseBucket,
    NotALeaseBucket,
    Outdated,
)
from holdfast.replication.leases.leases import Leases, Watcher
from holdfast.replication.leases.thread import Connect, LeaseThread, Relay, StartThread
from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes

__all__ = [
    "LEASE_TIMES",
    "Connect",
    "Entry",
    "Holding",
    "KeyBucket",
    "LeaseBucket",
    "LeaseThread",
    "LeaseTimes",
    "Leases",
    "NotALeaseBucket",
    "Outdated",
    "Relay",
    "StartThread",
    "Watcher",
]
