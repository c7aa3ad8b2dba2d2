"""Keeps subscriptions and states of devices in JetStream, so that a restart loses nothing.

All keys are in one bucket without TTL. `PREFIX.subscription.SUBSCRIBER.DEVICE.N` is a subscribe
request: a part of the tags of a subscriber, so that no value is larger than a message.
`PREFIX.status.DEVICE` is the last status of a device. Both are written when they change. JetStream
is optional: without it, nothing is kept, and nothing waits for it.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy
from nats.js.errors import NotFoundError

from holdfast import logs, tasks
from holdfast.scanner.jetstream.heartbeat import JETSTREAM_TIMEOUT, reason_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Set

    from nats.aio.client import Client
    from nats.js import JetStreamContext
    from nats.js.kv import KeyValue

BUCKET = "holdfast_scanner"
STREAM = f"KV_{BUCKET}"
PRE = f"$KV.{BUCKET}."

READING = 30.0
"""Seconds after which the server removes a reader that was left behind."""

FETCHED = 256
"""Entries that are read at once."""

FIRST_RETRY = 0.5
RETRIED = 10.0
"""Seconds between attempts while JetStream fails. Each failure doubles them, up to the second."""

TOGETHER = 16
"""Units that are written concurrently."""


@dataclass(frozen=True)
class Unit:
    """Keys that are written together: those of a subscriber of a device, or of its status."""

    device: str
    subscriber: str | None = None
    """`None` for the status."""


class Keeper:
    """Writes the wanted entries of units to the bucket, as soon as they are touched."""

    def __init__(
        self,
        prefix: str,
        entries: Callable[[Unit], Mapping[str, bytes]],
        found: Callable[[list[tuple[str, bytes]]], Mapping[str, Unit]],
    ) -> None:
        """`entries` returns what is to be stored for a unit: nothing, if it is gone.

        `found` gets the stored entries after each connection. It returns the units of those that
        are to be replaced or removed when their unit does not want them.
        """
        self._prefix = prefix
        self._entries = entries
        self._found = found
        self._client: Client | None = None
        self._news = asyncio.Event()
        self._touched: set[Unit] = set()
        self._writing: set[Unit] = set()
        self._waiting: dict[Unit, asyncio.Event] = {}
        self._stored: dict[Unit, dict[str, int]] = {}
        """The hashes of the stored entries, by key."""
        self._works: bool | None = None
        self._failures = 0
        self._busy = asyncio.Lock()
        """Held while entries are read or written."""
        self.tried = asyncio.Event()
        """Set after the first attempt to read the stored entries."""

    @property
    def touched(self) -> Set[Unit]:
        """The units that are not stored yet."""
        return self._touched | self._writing

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._client = client
        self._news.set()

    def touch(self, unit: Unit) -> None:
        """Writes a unit soon."""
        self._touched.add(unit)
        self._news.set()

    async def settled(self, unit: Unit) -> None:
        """Waits until a touched unit is stored; not while JetStream fails."""
        if not self._works or self._client is None:
            return
        if unit in self._touched or unit in self._writing:
            stored = self._waiting.setdefault(unit, asyncio.Event())
            await stored.wait()

    async def run(self) -> None:
        """Reads the entries after each connection, and writes units, until it is cancelled."""
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
                    if bucket is None:
                        bucket = await self._read(client)
                    await self._write(client.jetstream(timeout=JETSTREAM_TIMEOUT), bucket)
            except Exception as error:  # Keeping is optional, no error may stop the scanner.
                bucket = None
                if self._client is client:  # Else the connection has ended, and not JetStream.
                    self._failures += 1
                    self._tell(False, reason_of(error))
            else:
                self._failures = 0
                self._tell(True, "")
            self.tried.set()
            if not self._works:
                self._release()

    async def _wait(self) -> None:
        """Waits for work; while JetStream fails, for the next attempt."""
        if self._works is False and self._client is not None:
            client = self._client
            pause = min(FIRST_RETRY * 2 ** min(self._failures - 1, 10), RETRIED)
            try:
                async with asyncio.timeout(pause):
                    while self._client is client:
                        self._news.clear()
                        await self._news.wait()
            except TimeoutError:
                pass
            return
        await self._news.wait()
        self._news.clear()

    async def _read(self, client: Client) -> KeyValue:
        """Opens the bucket and reports its entries."""
        jetstream = client.jetstream(timeout=JETSTREAM_TIMEOUT)
        try:
            bucket = await jetstream.key_value(BUCKET)
        except NotFoundError:
            bucket = await jetstream.create_key_value(bucket=BUCKET, history=1)
        entries = []
        for kind in ("subscription.*.*.*", "status.*"):
            entries += await _entries(jetstream, f"{self._prefix}.{kind}")
        units = self._found(entries)
        self._stored = {}
        for key, value in entries:
            if key in units:
                self._stored.setdefault(units[key], {})[key] = hash(value)
        self._touched.update(units.values())
        return bucket

    async def _write(self, jetstream: JetStreamContext, bucket: KeyValue) -> None:
        """Writes all touched units. After an error, those that failed are still touched."""
        while self._touched:
            self._writing = {self._touched.pop() for _ in range(min(TOGETHER, len(self._touched)))}
            units = list(self._writing)
            work = (self._write_unit(jetstream, bucket, unit) for unit in units)
            results = await asyncio.gather(*work, return_exceptions=True)
            self._writing = set()
            errors = []
            for unit, result in zip(units, results, strict=True):
                if isinstance(result, BaseException):
                    self._touched.add(unit)
                    errors.append(result)
                elif unit not in self._touched and unit in self._waiting:
                    self._waiting.pop(unit).set()
            if errors:
                raise errors[0]

    async def _write_unit(self, jetstream: JetStreamContext, bucket: KeyValue, unit: Unit) -> None:
        wanted = self._entries(unit)
        stored = self._stored.setdefault(unit, {})
        for key, value in wanted.items():
            if stored.get(key) != hash(value):
                await bucket.put(key, value)
                stored[key] = hash(value)
        for key in [key for key in stored if key not in wanted]:
            await jetstream.purge_stream(STREAM, subject=PRE + key)  # Leaves no marker behind.
            del stored[key]
        if not stored:
            del self._stored[unit]

    def _release(self) -> None:
        """Lets requests go on that wait for JetStream."""
        for stored in self._waiting.values():
            stored.set()
        self._waiting.clear()

    async def stop(self) -> None:
        """Removes the states of devices, which nobody updates any more. Then writes nothing."""
        client, self._client = self._client, None
        self._news.set()
        if client is not None and self._works:
            jetstream = client.jetstream(timeout=JETSTREAM_TIMEOUT)
            async with self._busy:  # What is on its way to the server comes before the removal.
                await jetstream.purge_stream(STREAM, subject=f"{PRE}{self._prefix}.status.*")

    def _tell(self, works: bool, reason: str) -> None:
        if works is self._works:
            return
        if works:
            logs.write(logging.INFO, "subscriptions_kept", bucket=BUCKET)
        else:
            logs.write(logging.WARNING, "subscriptions_not_kept", bucket=BUCKET, reason=reason)
        self._works = works


async def _entries(jetstream: JetStreamContext, keys: str) -> list[tuple[str, bytes]]:
    """Returns the entries whose keys match.

    A watcher of nats-py may report the end before the first entry. The number of entries that a new
    pull consumer has is certain.
    """
    config = ConsumerConfig(
        deliver_policy=DeliverPolicy.LAST_PER_SUBJECT,
        ack_policy=AckPolicy.NONE,
        inactive_threshold=READING,
    )
    reader = await jetstream.pull_subscribe(PRE + keys, stream=STREAM, config=config)
    try:
        info = await reader.consumer_info()
        left = info.num_pending or 0
        found = []
        while left > 0:
            messages = await reader.fetch(min(left, FETCHED), timeout=JETSTREAM_TIMEOUT)
            left -= len(messages)
            found += [
                (message.subject.removeprefix(PRE), message.data)
                for message in messages
                if not message.headers  # Only markers of deleted keys have headers.
            ]
        await jetstream.delete_consumer(STREAM, info.name)
        return found
    finally:
        await reader.unsubscribe()
