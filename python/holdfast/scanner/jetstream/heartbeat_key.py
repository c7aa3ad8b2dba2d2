"""A heartbeat in a JetStream bucket, which shows other services that the scanner runs."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import TYPE_CHECKING

import msgspec
from nats.js.errors import KeyNotFoundError, NotFoundError

from holdfast.events import log_lines
from holdfast.runtime.malformed_json import MALFORMED_JSON
from holdfast.scanner.jetstream.availability import JETSTREAM_TIMEOUT_S, Availability
from holdfast.scanner.messages.types import Announcement, Heartbeat

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.client import Client
    from nats.js.kv import KeyValue

    from holdfast.scanner.messages.types import HeartbeatMetadata

BUCKET = "service_heartbeats"

HEARTBEAT_INTERVAL_S = 10.0
"""Time between two heartbeats."""

EXPIRES_AFTER_S = 60.0
"""Time after which a heartbeat expires if it is not renewed."""


class HeartbeatKey:
    """Writes heartbeats to one key of the bucket."""

    def __init__(
        self, key: str, metadata: Callable[[], HeartbeatMetadata], on_other: Callable[[int], object]
    ) -> None:
        """`on_other` is called with the start time of another service that writes the same key."""
        self._key = key
        self._metadata = metadata
        self._on_other = on_other
        self.started = _now()
        """Milliseconds since 1970."""
        self._revision: int | None = None
        """The revision of the own last heartbeat."""
        self._availability = Availability("heartbeat", "no_heartbeat", bucket=BUCKET, key=key)
        self._has_logged_missing_ttl = False
        self._stopped = False

    async def beat(self, client: Client | None) -> None:
        """Renews the heartbeat. Logs only the first of consecutive failures."""
        if client is None:
            return
        content = Heartbeat(
            service_type="modbus",
            module_id=self._key,
            last_seen=_now(),
            started_at=self.started,
            metadata=self._metadata(),
        )
        try:
            bucket = await _bucket(client)
            if not self._availability.is_available:
                await self._check_ttl(bucket)
            await self._look_for_others(bucket)
            self._revision = await bucket.put(self._key, msgspec.json.encode(content))
        except Exception as error:  # Heartbeats are optional, so no error may stop the scanner.
            if not self._stopped:
                self._availability.failed(error)
        else:
            if not self._stopped:
                self._availability.succeeded()

    async def _look_for_others(self, bucket: KeyValue) -> None:
        """Reports another service that has written the key since the own last heartbeat."""
        if self._revision is None:
            return
        try:
            found = await bucket.get(self._key)
            if found.revision == self._revision:
                return
            other = msgspec.json.decode(found.value or b"", type=Announcement)
        except (KeyNotFoundError, *MALFORMED_JSON):
            return
        if other.started_at != self.started:
            self._on_other(other.started_at)

    async def _check_ttl(self, bucket: KeyValue) -> None:
        """Logs once if heartbeats in the bucket never expire."""
        if self._has_logged_missing_ttl or (await bucket.status()).ttl:
            return
        self._has_logged_missing_ttl = True
        todo = (
            f"delete the bucket, so that it is created again, or set max_age {EXPIRES_AFTER_S:g} s"
        )
        log_lines.write(logging.WARNING, "heartbeat_has_no_end", bucket=BUCKET, todo=todo)

    async def stop(self, client: Client | None) -> None:
        """Deletes the heartbeat. A heartbeat that is still being renewed is not logged any more."""
        self._stopped = True
        if client is None or not self._availability.is_available:
            return
        with contextlib.suppress(Exception):
            async with asyncio.timeout(JETSTREAM_TIMEOUT_S):
                await (await _bucket(client)).delete(self._key)


async def _bucket(client: Client) -> KeyValue:
    """Returns the bucket; creates it if it does not exist."""
    jetstream = client.jetstream(timeout=JETSTREAM_TIMEOUT_S)
    try:
        return await jetstream.key_value(BUCKET)
    except NotFoundError:
        return await jetstream.create_key_value(bucket=BUCKET, history=1, ttl=EXPIRES_AFTER_S)


def _now() -> int:
    return int(time.time() * 1000)
