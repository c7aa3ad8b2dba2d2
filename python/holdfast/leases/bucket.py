"""A bucket of leases: makes it, changes keys by compare-and-set, and follows all keys.

`KeyValue` of nats-py can't renew a key with a TTL, and its `create` is late to find a key that the
server has deleted. Here every change names the revision that it replaces.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
from nats.errors import TimeoutError as NoAnswer
from nats.js.api import (
    AckPolicy,
    ConsumerConfig,
    DeliverPolicy,
    DiscardPolicy,
    StorageType,
    StreamConfig,
)
from nats.js.errors import APIError, NoStreamResponseError, NotFoundError

from holdfast.leases.entries import LEASE_TIMES, SETTLED, Entry, LeaseTimes, entry

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

TIMEOUT = 0.9
"""Seconds to wait for an answer of JetStream that is not about a lease."""

OPENING = 5.0
"""The same while the bucket is made."""

MARKER = 60.0
"""Seconds that the server keeps the mark of a key that has ended."""

WRONG_SEQUENCE = (10071, 10164)
"""Error codes of JetStream: the key has another revision than expected."""

IN_USE = 10058
"""The stream exists with other settings."""

NOT_CLUSTERED = 10074
"""The server is alone, and has no room for replicas."""

MESSAGE = 64 * 1024
"""The size limit of an entry in bytes."""


class NotALeaseBucket(Exception):
    """The bucket has other settings. Another attempt can't change that."""


class Outdated(Exception):
    """A key has another revision than expected."""


@dataclass(frozen=True)
class Made:
    """Which bucket it is: one of the same name may have been lost, or deleted."""

    at: datetime | None
    last: int
    """The last revision."""


class _Ack(msgspec.Struct):
    """The answer of JetStream to a message."""

    seq: int = 0
    error: dict[str, Any] | None = None


def first_revision(after: int) -> int:
    """Where the revisions of a new bucket begin: after those of a lost one of the same name.

    Who compares them, such as a consumer of values, may know only the lost one. No bucket has a
    million changes a second, so the time in microseconds is later, if the clock is right.
    """
    return max(after + 1, time.time_ns() // 1000)


async def made(jetstream: JetStreamContext, config: StreamConfig, replicas: int) -> None:
    """Makes a stream, unless another node has just made it; on one server, with one replica.

    Raises the errors of nats-py.
    """
    try:
        await jetstream.add_stream(config, num_replicas=replicas)
    except APIError as error:
        if error.err_code == NOT_CLUSTERED and replicas > 1:
            await made(jetstream, config, 1)
        elif error.err_code != IN_USE:
            raise


class LeaseBucket:
    """One bucket, over one connection."""

    def __init__(self, client: Client, name: str, times: LeaseTimes = LEASE_TIMES) -> None:
        self.name = name
        self._times = times
        self.client = client
        self._jetstream = client.jetstream(timeout=TIMEOUT)
        self._reading = client.jetstream(timeout=times.answer_timeout_s)
        self._stream = f"KV_{name}"
        self._pre = f"$KV.{name}."
        self._opening = asyncio.Lock()
        self._inbox: str | None = None
        self._numbers = itertools.count()
        self._waiting: dict[str, asyncio.Future[Msg]] = {}
        self._following: JetStreamContext.PushSubscription | None = None

    async def open(self, replicas: int = 1, after: int = 0) -> Made:
        """Makes the bucket, if there is none, with revisions after that one.

        Raises `NotALeaseBucket` and the errors of nats-py.
        """
        jetstream = self.client.jetstream(timeout=OPENING)
        try:
            # Short, because it is not answered later if there was no leader.
            info = await self._jetstream.stream_info(self._stream)
        except NotFoundError:
            config = StreamConfig(
                name=self._stream,
                subjects=[f"{self._pre}>"],
                max_msgs_per_subject=1,
                max_msg_size=MESSAGE,
                storage=StorageType.FILE,
                discard=DiscardPolicy.NEW,
                deny_delete=True,
                allow_rollup_hdrs=True,
                allow_direct=True,
                allow_msg_ttl=True,
                subject_delete_marker_ttl=MARKER,
                first_seq=first_revision(after),
            )
            await made(jetstream, config, replicas)
            info = await jetstream.stream_info(self._stream)
        found = info.config
        if not found.allow_msg_ttl or found.max_msgs_per_subject != 1:
            raise NotALeaseBucket(
                f"the bucket {self.name} exists without TTLs of keys or with a history: delete it, "
                "so that it is made again"
            )
        return Made(info.created, info.state.last_seq)

    async def settle(self) -> Entry:
        """Marks the bucket as one that is older than all leases of a former one.

        Raises as `put` does.
        """
        revision = await self._publish(SETTLED, b"{}", 0, {})
        return Entry(revision, None, time.monotonic())

    async def put(self, key: str, value: bytes, revision: int) -> int:
        """Replaces the revision of a key, 0 if there is none, until its TTL ends.

        Returns the new revision. Raises `Outdated` and the errors of nats-py.
        """
        ttl = {"Nats-TTL": f"{self._times.server_ttl_s}s"}
        return await self._publish(key, value, revision, ttl)

    async def delete(self, key: str, revision: int) -> None:
        """Deletes a key, which is given back. Raises as `put` does."""
        headers = {"KV-Operation": "DEL", "Nats-TTL": f"{MARKER:.0f}s"}
        await self._publish(key, b"", revision, headers)

    async def _publish(self, key: str, value: bytes, revision: int, headers: dict[str, str]) -> int:
        expected = {"Nats-Expected-Last-Subject-Sequence": str(revision)}
        answer = await self._answer(f"{self._pre}{key}", value, headers | expected)
        if (answer.headers or {}).get("Status") == "503":
            raise NoStreamResponseError
        ack = msgspec.json.decode(answer.data, type=_Ack)
        if ack.error is None:
            return ack.seq
        if ack.error.get("err_code") in WRONG_SEQUENCE:
            raise Outdated(key)
        APIError.from_error(ack.error)  # Raises the error of that code.
        raise AssertionError("it was raised")

    async def _answer(self, subject: str, value: bytes, headers: dict[str, str]) -> Msg:
        """Publishes a message, and waits for its answer.

        This is what `request` of nats-py does, for a fifth of its cost: a node renews hundreds of
        leases every second.
        """
        async with self._opening:
            if self._inbox is None:
                inbox = self.client.new_inbox()
                await self.client.subscribe(f"{inbox}.*", cb=self._answered)
                self._inbox = inbox
        number = str(next(self._numbers))
        answered: asyncio.Future[Msg] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answered
        try:
            reply = f"{self._inbox}.{number}"
            await self.client.publish(subject, value, reply=reply, headers=headers)
            async with asyncio.timeout(self._times.answer_timeout_s):
                return await answered
        except TimeoutError:
            raise NoAnswer from None
        finally:
            del self._waiting[number]

    async def _answered(self, message: Msg) -> None:
        waiting = self._waiting.get(message.subject.rpartition(".")[2])
        if waiting is not None and not waiting.done():
            waiting.set_result(message)

    async def get(self, key: str) -> Entry | None:
        """Reads a key. Raises the errors of nats-py."""
        try:
            found = await self._reading.get_last_msg(self._stream, f"{self._pre}{key}")
        except NotFoundError:
            return None
        return entry(found.seq or 0, found.headers, found.data or b"", time.monotonic())

    async def follow(self, take: Callable[[str, Entry], None], read: Callable[[], None]) -> None:
        """Passes on all keys, and then their changes, until `unfollow`.

        Calls `read` after all keys. Raises the errors of nats-py.
        """

        async def taken(message: Msg) -> None:
            metadata, now = message.metadata, time.monotonic()
            found = entry(metadata.sequence.stream, message.headers, message.data, now)
            take(message.subject.removeprefix(self._pre), found)
            if not metadata.num_pending:
                read()

        config = ConsumerConfig(
            deliver_policy=DeliverPolicy.LAST_PER_SUBJECT,
            ack_policy=AckPolicy.NONE,
            mem_storage=True,
            num_replicas=1,
            inactive_threshold=30.0,
        )
        following = self._following = await self._jetstream.subscribe(
            f"{self._pre}>", stream=self._stream, config=config, cb=taken
        )
        info = await following.consumer_info()
        if not info.num_pending and not (info.delivered and info.delivered.consumer_seq):
            read()

    async def unfollow(self) -> None:
        """Ends `follow`."""
        following, self._following = self._following, None
        if following is not None:
            await following.unsubscribe()
