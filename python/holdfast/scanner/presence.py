"""Shows that the scanner runs, and notices other scanners on the same subjects."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import msgspec

from holdfast import _core
from holdfast.runtime import tasks
from holdfast.scanner.jetstream.heartbeat import HeartbeatKey
from holdfast.scanner.messages.types import Announcement, HeartbeatMetadata
from holdfast.scanner.nats import wire
from holdfast.scanner.other_scanners import OtherScanners

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast.scanner.jetstream.buckets import Buckets
    from holdfast.scanner.nats.outbox import Outbox
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.subscriptions.registry import Registry

HEARTBEAT_INTERVAL_S = 10.0


class Presence:
    """Announces the scanner on `PREFIX.scanner`, and writes its heartbeat."""

    def __init__(
        self,
        prefix: str,
        registry: Registry,
        buckets: Buckets,
        placement: Placement,
        outbox: Outbox,
        client: Callable[[], Client | None],
    ) -> None:
        """`client` returns the client while there is a connection."""
        self._subject = f"{prefix}.scanner"
        self._registry = registry
        self._buckets = buckets
        self._placement = placement
        self._outbox = outbox
        self._client = client
        self._is_due = asyncio.Event()
        """Set when the next heartbeat is due immediately."""
        self.heartbeat = HeartbeatKey(prefix, self._metadata, self._saw)
        self.other_scanners = OtherScanners(self.heartbeat.started)

    @property
    def started(self) -> int:
        """When the scanner was started, in milliseconds since 1970."""
        return self.heartbeat.started

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
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(HEARTBEAT_INTERVAL_S):
                    await self._is_due.wait()

    async def stop(self) -> None:
        """Deletes the heartbeat, unless other nodes of the fleet go on with it."""
        if not self._placement.has_others:
            await self.heartbeat.stop(self._client())

    async def announced(self, message: Msg) -> None:
        """Handles the announcement of another scanner, or of this one."""
        with contextlib.suppress(msgspec.DecodeError):
            other = msgspec.json.decode(message.data, type=Announcement)
            # The nodes of a fleet share their devices: they are no competitors.
            if other.fleet is None or other.fleet != self._placement.fleet:
                self._saw(other.started_at)

    def _saw(self, started: int) -> None:
        if self.other_scanners.saw(started):
            self._announce()  # The other one may have been started later, and not know this one.

    def _announce(self) -> None:
        content = Announcement(started_at=self.started, fleet=self._placement.fleet)
        if self._client() is not None:
            self._outbox.put([((self._subject,), wire.message(self._subject, content))])

    def _metadata(self) -> HeartbeatMetadata:
        return HeartbeatMetadata(
            device_count=len(self._registry.devices),
            tag_count=self._registry.tags,
            version=_core.__version__,
            enabled=self._buckets.is_enabled,
        )
