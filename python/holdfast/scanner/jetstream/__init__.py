"""What the scanner keeps in JetStream, and what it reads there."""

from __future__ import annotations

from holdfast.scanner.jetstream.availability import State
from holdfast.scanner.jetstream.heartbeat import HeartbeatKey
from holdfast.scanner.jetstream.key_watch import WATCH_TIMES, WatchTimes
from holdfast.scanner.jetstream.store import BUCKET, EntryStore

__all__ = ["BUCKET", "WATCH_TIMES", "EntryStore", "HeartbeatKey", "State", "WatchTimes"]
