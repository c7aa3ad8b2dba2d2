"""Shows that the scanner runs, and notices other scanners on the same subjects.

Each request reaches all of them, and each polls the device. A scanner announces itself on
`PREFIX.scanner`. tentacle-modbus does not; it is noticed because it writes the same heartbeat.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from holdfast import _core
from holdfast.events import log_lines
from holdfast.net.nats import batch
from holdfast.runtime import tasks
from holdfast.runtime.malformed_json import MALFORMED_JSON
from holdfast.scanner.jetstream.heartbeat_key import HEARTBEAT_INTERVAL_S, HeartbeatKey
from holdfast.scanner.messages.types import Announcement, HeartbeatMetadata, OtherScanner

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast.net.nats.outbox import Outbox
    from holdfast.scanner.jetstream.buckets import Buckets
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.subscriptions.registry import Registry

FORGET_AFTER_S = 3 * HEARTBEAT_INTERVAL_S
"""Time after the last sign of another scanner until it is forgotten."""

MAX_SCANNERS = 100
"""Limit of other scanners that are remembered. Further ones are not noticed."""


class OtherScanners:
    """The other scanners, by the time of their start."""

    def __init__(self, started: int) -> None:
        self._started = started
        self._seen: dict[int, float] = {}

    def saw(self, started: int) -> bool:
        """Records a sign of another scanner. Returns whether it is a new one, and then logs it."""
        if started == self._started:
            return False
        now = time.monotonic()
        self._expire(now)
        is_new = started not in self._seen
        if is_new and len(self._seen) >= MAX_SCANNERS:
            return False
        self._seen[started] = now
        if is_new:
            todo = (
                "stop one of them, or give it another --prefix; "
                "nodes of one fleet must use the same JetStream"
            )
            log_lines.limited(
                logging.WARNING,
                "another_scanner",
                kind="announcement",
                started=log_lines.timestamp(started / 1000),
                todo=todo,
            )
        return is_new

    def current(self) -> list[OtherScanner]:
        """Returns the other scanners that are running."""
        self._expire(time.monotonic())
        return [OtherScanner(started_at=started) for started in sorted(self._seen)]

    def _expire(self, now: float) -> None:
        self._seen = {
            started: seen for started, seen in self._seen.items() if now - seen < FORGET_AFTER_S
        }


@dataclass(eq=False)
class Presence:
    """Announces the scanner on `PREFIX.scanner`, and writes its heartbeat."""

    _prefix: str
    _registry: Registry
    _buckets: Buckets
    _placement: Placement
    _outbox: Outbox
    _client: Callable[[], Client | None]
    """Returns the client while there is a connection."""
    _is_due: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the next heartbeat is due immediately."""

    def __post_init__(self) -> None:
        self._subject = f"{self._prefix}.scanner"
        self.heartbeat = HeartbeatKey(self._prefix, self._metadata, self._saw)
        self.other_scanners = OtherScanners(self.heartbeat.started)

    def beat_soon(self) -> None:
        """Makes the next heartbeat due immediately."""
        self._is_due.set()

    async def run(self) -> None:
        """Announces the scanner and writes heartbeats, until it is cancelled."""
        while True:
            self._is_due.clear()
            self._announce()
            if self._placement.writes_heartbeat:
                await self.heartbeat.beat(self._client())
            tasks.check()  # nats-py may have swallowed a cancellation during the heartbeat.
            await tasks.within(HEARTBEAT_INTERVAL_S, self._is_due.wait())

    async def stop(self) -> None:
        """Deletes the heartbeat, unless other nodes of the fleet go on with it."""
        if not self._placement.has_others:
            await self.heartbeat.stop(self._client())

    async def announced(self, message: Msg) -> None:
        """Handles the announcement of another scanner, or of this one."""
        with contextlib.suppress(*MALFORMED_JSON):
            other = msgspec.json.decode(message.data, type=Announcement)
            if not self._placement.shares_devices(other):
                self._saw(other.started_at)

    def _saw(self, started: int) -> None:
        if self.other_scanners.saw(started):
            self._announce()  # The other one may have been started later, and not know this one.

    def _announce(self) -> None:
        content = self._placement.announcement(self.heartbeat.started)
        if self._client() is not None:
            self._outbox.put([((self._subject,), batch.message(self._subject, content))])

    def _metadata(self) -> HeartbeatMetadata:
        return HeartbeatMetadata(
            device_count=len(self._registry.devices),
            tag_count=self._registry.tags,
            version=_core.__version__,
            enabled=self._buckets.is_enabled,
        )
