"""Whether the primary host is online: without it, an edge node keeps its values."""

from __future__ import annotations

import threading
from typing import Any

import msgspec

from holdfast.runtime.malformed_json import MALFORMED_JSON

HOST_STATE_TIMEOUT_S = 2.0
"""Seconds to wait for the state of the primary host after connecting."""


class PrimaryHost:
    """The state of a host. Thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.is_online = False
        self._since: int | None = None
        self._is_known = False

    def begin(self) -> None:
        """Begins a connection, in which the state is unknown at first."""
        with self._changed:
            self.is_online = self._is_known = False

    def take(self, payload: bytes) -> None:
        """Takes a STATE message. Raises `ValueError` for one that is malformed.

        A message that is older than the last one does not count: it is the will of a connection
        that the host has replaced. If it says that the host is online, that is an error too: the
        clock of the host was set back.
        """
        online, timestamp = _parsed(payload)
        with self._changed:
            if self._since is not None and timestamp < self._since:
                if online:
                    older = (self._since - timestamp) / 1000
                    raise ValueError(f"online, but {older:g} s older than the last STATE message")
                return
            self._since, self.is_online, self._is_known = timestamp, online, True
            self._changed.notify_all()

    def wait(self) -> None:
        """Waits for the first message."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_known, HOST_STATE_TIMEOUT_S)


def _parsed(payload: bytes) -> tuple[bool, int]:
    try:
        found: Any = msgspec.json.decode(payload)
    except MALFORMED_JSON:
        found = None
    if isinstance(found, dict):
        online, timestamp = found.get("online"), found.get("timestamp")
        if isinstance(online, bool) and type(timestamp) is int:
            return online, timestamp
    raise ValueError("not the JSON of a STATE message: online and timestamp")
