"""Keeps subscriptions and states of devices in JetStream, so that a restart loses nothing.

All keys are in one bucket without TTL. `PREFIX.subscription.SUBSCRIBER.DEVICE.N` is a subscribe
request: a part of the tags of a subscriber, so that no value is larger than a message.
`PREFIX.status.DEVICE` is the last status of a device. Both are written when they change. JetStream
is optional: without it, nothing is kept, and nothing waits for it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from functools import partial
from typing import TYPE_CHECKING

from nats.js.errors import NotFoundError

from holdfast.events import log_lines
from holdfast.net.nats.outbox import USUAL_MAX_PAYLOAD_BYTES
from holdfast.runtime import tasks
from holdfast.runtime.backoff import Backoff
from holdfast.scanner.jetstream.availability import (
    FIRST_RETRY_S,
    JETSTREAM_TIMEOUT_S,
    MAX_RETRY_S,
    Availability,
    State,
)
from holdfast.scanner.jetstream.bucket_ttl import TtlRemoval
from holdfast.scanner.jetstream.entries import status_keys, subscription_keys
from holdfast.scanner.jetstream.key_watch import reading

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Set

    from nats.aio.client import Client
    from nats.js import JetStreamContext
    from nats.js.api import StreamConfig
    from nats.js.kv import KeyValue

    from holdfast.scanner.subscriptions.key import SubscriptionKey

BUCKET = "holdfast_scanner"
STREAM = f"KV_{BUCKET}"
KEY_SUBJECTS = f"$KV.{BUCKET}."

MAX_CONCURRENT_WRITES = 16
"""Subscriptions that are written at once."""

CHECK_INTERVAL_S = 10.0
"""Between looks whether the bucket was deleted, replaced or changed, which NATS does not tell."""


class EntryStore:
    """Writes entries to the bucket, as soon as their owner is touched.

    An owner of entries is a subscription, or the status of a device.
    """

    def __init__(
        self,
        prefix: str,
        entries: Callable[[SubscriptionKey], Mapping[str, bytes] | None],
        on_read: Callable[[list[tuple[str, bytes]]], Mapping[str, SubscriptionKey]],
    ) -> None:
        """`entries` returns what is to be stored for an owner: nothing, if it is gone.

        `None` leaves what is stored as it is.

        `on_read` gets the stored entries after each connection. It returns the owners of those that
        are to be replaced or removed when their owner does not want them. It touches all owners
        that want entries.
        """
        self._prefix = prefix
        self._entries = entries
        self._on_read = on_read
        self._client: Client | None = None
        self._has_work = asyncio.Event()
        self._touched: set[SubscriptionKey] = set()
        self._writing: set[SubscriptionKey] = set()
        self._waiting: dict[SubscriptionKey, asyncio.Event] = {}
        self._stored: dict[SubscriptionKey, dict[str, int]] = {}
        """The hashes of the stored entries, by key."""
        self._too_large: dict[SubscriptionKey, str] = {}
        """Owners of which an entry is too large for the server, and why: it is not stored."""
        self._oversized: set[str] = set()
        """Keys of stored entries that the server would not take any more."""
        self.max_bytes = USUAL_MAX_PAYLOAD_BYTES
        """The size limit of an entry: that of messages."""
        self._owners: dict[str, SubscriptionKey] = {}
        """The owners of the stored entries, by key. Two device ids can have the same keys."""
        events = "subscriptions_kept", "subscriptions_not_kept"
        self._availability = Availability(*events, bucket=BUCKET)
        self._backoff = Backoff(FIRST_RETRY_S, MAX_RETRY_S, jitter=True)
        self._pause_s = 0.0
        self._made_at = ""
        """When the bucket was made that was read last."""
        self._checked_at = 0.0
        self._settings: StreamConfig | None = None
        """Those of the bucket at the last look."""
        self._ttl = TtlRemoval()
        self._busy = asyncio.Lock()
        """Held while entries are read or written."""
        self.tried = asyncio.Event()
        """Set after the first attempt to read the stored entries."""

    @property
    def touched(self) -> Set[SubscriptionKey]:
        """The owners that are not stored yet."""
        return self._touched | self._writing

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._client = client
        if client is not None:
            self.max_bytes = client.max_payload
        self._has_work.set()

    def touch(self, owner: SubscriptionKey) -> None:
        """Writes the entries of an owner soon."""
        self._touched.add(owner)
        self._has_work.set()

    async def wait_until_written(self, owner: SubscriptionKey) -> bool:
        """Waits until the entries of a touched owner are stored; not while JetStream fails.

        Returns whether one of them is too large for the server.
        """
        if not self._availability.is_available or self._client is None:
            return False
        if owner in self._touched or owner in self._writing:
            stored = self._waiting.setdefault(owner, asyncio.Event())
            await stored.wait()
        return owner in self._too_large

    async def run(self) -> None:
        """Reads the entries after each connection, and writes changes, until it is cancelled."""
        bucket: KeyValue | None = None
        client: Client | None = None
        while True:
            tasks.check()
            await self._wait()
            if self._client is not client:
                client, bucket = self._client, None
            if client is None:
                self._release()
                continue
            try:
                async with self._busy:
                    if bucket is None or not await self._is_same(client):
                        bucket = await self._read(client)
                    await self._write(client.jetstream(timeout=JETSTREAM_TIMEOUT_S), bucket)
            except Exception as error:  # Keeping is optional, no error may stop the scanner.
                bucket = None
                if self._client is client:  # Else the connection has ended, and not JetStream.
                    self._pause_s = self._backoff.failed()
                    self._availability.failed(error)
                    # Requests must not fill memory while JetStream fails. `on_read` will touch all
                    # that is known: only what is gone, but stored, must be remembered.
                    self._touched.intersection_update(self._stored)
            else:
                self._backoff.succeeded()
                self._availability.succeeded()
            self.tried.set()
            if not self._availability.is_available:
                self._release()
            elif self._settings is not None and await self._ttl.remove(client, self._settings):
                bucket = None  # It may have lost entries: they are stored again.
                self._has_work.set()

    async def _wait(self) -> None:
        """Waits for work; while JetStream fails, for the next attempt."""
        if self._availability.state is State.UNAVAILABLE and self._client is not None:
            client = self._client
            try:
                async with asyncio.timeout(self._pause_s):
                    while self._client is client:
                        self._has_work.clear()
                        await self._has_work.wait()
            except TimeoutError:
                pass
            return
        await tasks.within(CHECK_INTERVAL_S, self._has_work.wait())
        self._has_work.clear()

    async def _is_same(self, client: Client) -> bool:
        """Whether the bucket is still the one that was read. Raises an error if there is none."""
        if time.monotonic() < self._checked_at + CHECK_INTERVAL_S:
            return True
        return await self._look(client) == self._made_at

    async def _look(self, client: Client) -> str:
        """Notes the settings of the bucket. Returns when it was made."""
        found = await client.jetstream(timeout=JETSTREAM_TIMEOUT_S).stream_info(STREAM)
        self._settings, self._checked_at = found.config, time.monotonic()
        return str(found.created)

    async def _read(self, client: Client) -> KeyValue:
        """Opens the bucket and reports its entries."""
        jetstream = client.jetstream(timeout=JETSTREAM_TIMEOUT_S)
        try:
            bucket = await jetstream.key_value(BUCKET)
        except NotFoundError:
            bucket = await jetstream.create_key_value(bucket=BUCKET, history=1)
        self._made_at = await self._look(client)
        entries = []
        for keys in (f"{subscription_keys(self._prefix)}*.*.*", f"{status_keys(self._prefix)}*"):
            async with reading(jetstream, BUCKET, keys) as reader:
                found = await reader.fetch_all()
            entries += [(key, each.value) for key, each in found.items() if each is not None]
        owners = self._on_read(entries)
        self._stored, self._owners = {}, dict(owners)
        self._oversized = {key for key, value in entries if len(value) > self.max_bytes}
        for key, value in entries:
            if key in owners:
                self._stored.setdefault(owners[key], {})[key] = hash(value)
        self._touched.update(owners.values())
        return bucket

    async def _write(self, jetstream: JetStreamContext, bucket: KeyValue) -> None:
        """Writes the entries of all touched owners. Those that failed are still touched then."""
        while self._touched:
            count = min(MAX_CONCURRENT_WRITES, len(self._touched))
            self._writing = {self._touched.pop() for _ in range(count)}
            owners = list(self._writing)
            # All writes before the first purge: the server may carry out both in any order, and a
            # purge must not remove what another owner has written under the same key.
            puts = (self._put(bucket, owner) for owner in owners)
            wanted = await asyncio.gather(*puts, return_exceptions=True)
            purges = map(partial(self._purge, jetstream), owners, wanted)
            results = await asyncio.gather(*purges, return_exceptions=True)
            self._writing = set()
            errors = []
            for owner, result in zip(owners, results, strict=True):
                if isinstance(result, BaseException):
                    self._touched.add(owner)
                    errors.append(result)
                # An owner that was touched again meanwhile is written again first.
                elif owner not in self._touched and owner in self._waiting:
                    self._waiting.pop(owner).set()
            if errors:
                raise errors[0]

    async def _put(self, bucket: KeyValue, owner: SubscriptionKey) -> Set[str]:
        """Writes the entries of an owner, except those too large. Returns the keys that stay."""
        entries = self._entries(owner)
        stored = self._stored.setdefault(owner, {})
        if entries is None:
            return stored.keys()
        too_large: dict[str, int] = {}
        for key, value in entries.items():
            if stored.get(key) == hash(value):  # A hash: values may take 128 KiB each.
                continue
            if len(value) > self.max_bytes:  # It must not delay the others.
                too_large[key] = len(value)
                continue
            former = self._owners.get(key, owner)
            if former != owner:  # It must not purge the key any more.
                self._stored[former].pop(key, None)
            self._owners[key] = owner
            stored[key] = hash(value)  # After an error, everything is read again.
            self._oversized.discard(key)
            await bucket.put(key, value)
        self._note_too_large(owner, too_large.values())
        # Only an entry from before the server's limit was lowered has what is too large now.
        kept = self._oversized & stored.keys() if too_large else set()
        return (entries.keys() - too_large.keys()) | kept

    async def _purge(
        self,
        jetstream: JetStreamContext,
        owner: SubscriptionKey,
        wanted: Set[str] | BaseException,
    ) -> None:
        """Removes the other entries of an owner. Raises the error of `_put`."""
        if isinstance(wanted, BaseException):
            raise wanted
        stored = self._stored[owner]
        for key in [key for key in stored if key not in wanted]:
            # Unlike a deletion, a purge leaves no marker behind.
            await jetstream.purge_stream(STREAM, subject=KEY_SUBJECTS + key)
            del stored[key], self._owners[key]
            self._oversized.discard(key)
        if not stored:
            del self._stored[owner]

    def _note_too_large(self, owner: SubscriptionKey, sizes: Collection[int]) -> None:
        """Notes, and logs once, that entries of an owner are too large; that none is, if so."""
        if not sizes:
            self._too_large.pop(owner, None)
            return
        reason = f"an entry takes {max(sizes)} bytes, the server takes {self.max_bytes}"
        if self._too_large.get(owner) != reason:
            self._too_large[owner] = reason
            fields = {"bucket": BUCKET, **owner.fields}
            log_lines.write(logging.WARNING, "subscriptions_not_kept", **fields, reason=reason)

    def _release(self) -> None:
        """Lets requests go on that wait for JetStream."""
        for stored in self._waiting.values():
            stored.set()
        self._waiting.clear()

    async def stop(self) -> None:
        """Removes the states of devices, which would be out of date. Then writes nothing."""
        client, self._client = self._client, None
        self._has_work.set()
        if client is not None and self._availability.is_available:
            jetstream = client.jetstream(timeout=JETSTREAM_TIMEOUT_S)
            async with self._busy:  # What is on its way to the server comes before the removal.
                await jetstream.purge_stream(
                    STREAM, subject=f"{KEY_SUBJECTS}{status_keys(self._prefix)}*"
                )
