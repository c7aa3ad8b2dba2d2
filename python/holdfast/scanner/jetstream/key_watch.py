"""Follows the keys of a JetStream bucket: reads all of them, then each change.

It starts again with all keys after each connection, after an error of JetStream, and when it has
missed a change. A missing bucket is created. A key that a lost bucket had is not a deleted one.

It is for buckets that other programs write, and waits until changes have settled. Nodes that change
keys together follow them with `net.nats.key_bucket`, which passes on each message at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy
from nats.js.errors import NotFoundError

from holdfast.events import log_lines
from holdfast.net.nats.key_bucket import is_marker
from holdfast.runtime import tasks
from holdfast.runtime.backoff import Backoff
from holdfast.scanner.jetstream.availability import (
    FIRST_RETRY_S,
    JETSTREAM_TIMEOUT_S,
    MAX_RETRY_S,
    Availability,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

READER_EXPIRES_S = 30.0
"""Time after which the server removes a reader that was left behind."""

FETCH_BATCH = 256
"""Entries that are read at once."""

MAX_FIRST_READ_WAIT_S = 2.0
"""How long requests wait for the bucket to be read. After that, reading continues."""

MAX_SETTLE_S = 2.0
"""Time after which changes are reported, even if further ones follow."""


@dataclass(frozen=True)
class WatchTimes:
    """When something is done about a bucket, in seconds."""

    quiet_s: float = 5.0
    """Without a change for so long, it is checked that the server still has the reader."""
    settle_s: float = 0.2
    """Without a further change for so long, changes are reported. Programs of tentacle-next delete
    an entry before they write it again."""
    retry_s: float = MAX_RETRY_S
    """Until what failed or was refused is tried again, at most."""


WATCH_TIMES = WatchTimes()


class Written(NamedTuple):
    """A value of a key, and the number of the message that wrote it."""

    value: bytes
    revision: int


class _Missed(Exception):
    """A change was not received."""


class KeyWatch:
    """Follows the keys of one bucket."""

    def __init__(
        self,
        bucket: str,
        keys: str,
        on_change: Callable[[Mapping[str, Written | None]], Awaitable[None]],
        times: WatchTimes,
    ) -> None:
        """`keys` is a key, or `>` for all.

        `on_change` gets what keys have, `None` for a deleted one: at first all keys, then each
        change, and all keys again whenever this starts again. A key that is only missing is not
        deleted: the server has lost it.
        """
        self._bucket = bucket
        self._keys = keys
        self._on_change = on_change
        self._times = times
        self._client: Client | None = None
        self._has_new_client = asyncio.Event()
        self._known: set[str] = set()
        """The keys that the bucket has, as far as it is known: the log has how many are lost."""
        events = "bucket_watched", "bucket_not_watched"
        self._availability = Availability(*events, bucket=bucket)
        self._backoff = Backoff(FIRST_RETRY_S, times.retry_s, jitter=True)
        self.tried = asyncio.Event()
        """Set after the first attempt to read the bucket."""

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._client = client
        self._has_new_client.set()

    async def read(self) -> None:
        """Waits until the bucket is read for the first time, but not for long."""
        if not self.tried.is_set():
            await tasks.within(MAX_FIRST_READ_WAIT_S, self.tried.wait())

    async def run(self) -> None:
        """Follows the bucket, until it is cancelled."""
        while True:
            await self._has_new_client.wait()
            self._has_new_client.clear()
            if self._client is None:
                continue
            works = (self._keep_following(self._client), self._has_new_client.wait())
            running = [asyncio.create_task(work) for work in works]
            try:  # However following has ended: the next connection begins it again.
                await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            finally:
                await tasks.end(running)

    async def _keep_following(self, client: Client) -> None:
        while not client.is_closed:  # nats-py then replaces a cancellation by an error.
            pause = FIRST_RETRY_S
            try:
                await self._follow(client)
            except _Missed:
                pass  # JetStream works: all keys are read again soon.
            except Exception as error:  # JetStream may fail in any way; it is tried again.
                pause = self._backoff.failed()
                if self._client is client:  # Else the connection has ended, and not JetStream.
                    self._availability.failed(error)
                self.tried.set()
            if not client.is_closed:
                await asyncio.sleep(pause)

    async def _follow(self, client: Client) -> None:
        """Reads all keys, then reports changes. Raises `_Missed`, or an error of JetStream."""
        jetstream = client.jetstream(timeout=JETSTREAM_TIMEOUT_S)
        try:
            await jetstream.stream_info(f"KV_{self._bucket}")
        except NotFoundError:
            await jetstream.create_key_value(bucket=self._bucket, history=1)
        async with reading(jetstream, self._bucket, self._keys) as reader:
            found = await reader.fetch_all()
            if lost := len(self._known - found.keys()):
                log_lines.write(logging.WARNING, "bucket_lost", bucket=self._bucket, keys=lost)
                self._known.clear()
            await self._report(found)
            self._backoff.succeeded()
            self._availability.succeeded()
            self.tried.set()
            while True:
                if changes := await reader.changes(self._times):
                    await self._report(changes)

    async def _report(self, changes: Mapping[str, Written | None]) -> None:
        self._known -= changes.keys()
        self._known |= {key for key, written in changes.items() if written is not None}
        await self._on_change(changes)


class Reader:
    """A consumer of a bucket's messages.

    A watcher of nats-py may report the end before the first key. The number of messages that a new
    pull consumer has is certain.
    """

    def __init__(
        self, jetstream: JetStreamContext, bucket: str, consumer: JetStreamContext.PullSubscription
    ) -> None:
        self._jetstream = jetstream
        self._bucket = bucket
        self._consumer = consumer
        self._received = 0
        """The number of the last message, counted by the server."""

    async def fetch_all(self) -> dict[str, Written | None]:
        """Returns all keys that there are now, the deleted ones too."""
        info = await self._consumer.consumer_info()
        self._name, count = info.name, info.num_pending or 0
        found: dict[str, Written | None] = {}
        while (left := count - self._received) > 0:
            found |= await self.fetch(min(left, FETCH_BATCH), JETSTREAM_TIMEOUT_S)
        return found

    async def changes(self, times: WatchTimes) -> dict[str, Written | None]:
        """Waits for changes. Returns them when no more follow, or nothing after a while."""
        try:
            found = await self.fetch(1, times.quiet_s)
        except TimeoutError:
            await self._check()
            return {}
        end = time.monotonic() + MAX_SETTLE_S
        with contextlib.suppress(TimeoutError):
            while time.monotonic() < end:
                found |= await self.fetch(FETCH_BATCH, times.settle_s)
        return found

    async def fetch(self, most: int, timeout: float) -> dict[str, Written | None]:
        """Returns the next messages, at least one. Raises `TimeoutError` if there are none."""
        return dict(map(self._read, await self._consumer.fetch(most, timeout=timeout)))

    def _read(self, message: Msg) -> tuple[str, Written | None]:
        number = message.metadata.sequence.consumer
        if number != self._received + 1:  # The server counts what it sends without gaps.
            raise _Missed
        self._received = number
        key = message.subject.removeprefix(f"$KV.{self._bucket}.")
        revision = message.metadata.sequence.stream
        return key, None if is_marker(message.headers or {}) else Written(message.data, revision)

    async def _check(self) -> None:
        """Checks that the server has the consumer, and delivered nothing that did not arrive."""
        info = await self._consumer.consumer_info()
        delivered = 0 if info.delivered is None else info.delivered.consumer_seq
        if delivered != self._received and self._consumer.pending_msgs == 0:
            raise _Missed

    async def close(self) -> None:
        """Ends the subscription, which nats-py would repeat after each reconnect."""
        with contextlib.suppress(Exception):
            await self._consumer.unsubscribe()

    async def delete(self) -> None:
        """Deletes the consumer, if the server can be reached. It expires anyway."""
        with contextlib.suppress(Exception):
            await self._jetstream.delete_consumer(f"KV_{self._bucket}", self._name)


@contextlib.asynccontextmanager
async def reading(jetstream: JetStreamContext, bucket: str, keys: str) -> AsyncIterator[Reader]:
    """Has a consumer of these keys. Raises errors of nats-py."""
    config = ConsumerConfig(
        deliver_policy=DeliverPolicy.LAST_PER_SUBJECT,
        ack_policy=AckPolicy.NONE,
        inactive_threshold=READER_EXPIRES_S,
    )
    subject, stream = f"$KV.{bucket}.{keys}", f"KV_{bucket}"
    consumer = await jetstream.pull_subscribe(subject, stream=stream, config=config)
    reader = Reader(jetstream, bucket, consumer)
    try:
        yield reader
    except Exception:
        await reader.delete()
        raise
    else:
        await reader.delete()
    finally:
        await reader.close()
