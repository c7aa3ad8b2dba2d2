"""Leases in a bucket of NATS JetStream: which of several nodes may use something, such as a device.

A lease is a key with a TTL. Its holder renews it, and stops by its own clock if it can't: everyone
else waits longer than that before they take it. `LeaseTimes` are these times.
"""

from __future__ import annotations

from holdfast.leases.bucket import LeaseBucket, NotALeaseBucket, Outdated, first_revision, made
from holdfast.leases.entries import LEASE_TIMES, Entry, Holding, LeaseTimes
from holdfast.leases.leases import Leases, Watcher
from holdfast.leases.thread import Connect, LeaseThread, Relay, StartThread

__all__ = [
    "LEASE_TIMES",
    "Connect",
    "Entry",
    "Holding",
    "LeaseBucket",
    "LeaseThread",
    "LeaseTimes",
    "Leases",
    "NotALeaseBucket",
    "Outdated",
    "Relay",
    "StartThread",
    "Watcher",
    "first_revision",
    "made",
]
