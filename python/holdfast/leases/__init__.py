"""Leases in a bucket of NATS JetStream: which of several nodes may use something, such as a device.

A lease is a key with a TTL. Its holder renews it every second, and stops by its own clock if it
can't: everyone else waits longer than that before they take it.
"""

from __future__ import annotations

from holdfast.leases.bucket import LeaseBucket, NotALeaseBucket, Outdated, first_revision, made
from holdfast.leases.entries import HELD, RENEWED, TTL, Entry, Holding
from holdfast.leases.leases import Leases, Watcher
from holdfast.leases.thread import Connect, LeaseThread, Relay, StartThread

__all__ = [
    "HELD",
    "RENEWED",
    "TTL",
    "Connect",
    "Entry",
    "Holding",
    "LeaseBucket",
    "LeaseThread",
    "Leases",
    "NotALeaseBucket",
    "Outdated",
    "Relay",
    "StartThread",
    "Watcher",
    "first_revision",
    "made",
]
