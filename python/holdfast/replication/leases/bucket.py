"""A bucket of leases: makes it, changes keys by compare-and-set, and follows all keys.

`KeyValue` of nats-py can't renew a key with a TTL, and its `create` is late to find a key that the
server has deleted. Here every change names the revision that it replaces.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import msgspec
from nats.errors import Error
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

from holdfast.net.nats.tolerant_client import ServerError, as_quoted
from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from holdfast.runtime.malformed_json import MALFORMED_JSON
from holdfast.runtime.text import counted, quote

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext
    from nats.js.api import RawStreamMsg, StreamInfo

SETTLED = "_settled"
"""The key that marks a bucket as at least `LeaseTimes.ttl_s` old. Until it exists, no lease is
taken: leases from a lost bucket of the same name may still be in use."""


class Holding(msgspec.Struct, frozen=True, kw_only=True):
    """The value of a lease."""

    node: str
    process: str
    """A random text of the process that holds it: a restarted node is another holder."""
    taken: int = 0
    """Milliseconds since 1970 at which the holder took it."""
    about: dict[str, Any] = {}
    """What else the holder tells of it."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A key, as it was last seen."""

    revision: int
    holding: Holding | None
    """`None` if nobody holds it."""
    seen: float
    """When this revision was first seen, on the own monotonic clock."""
    is_given_back: bool = False
    """Whether its holder has ended all uses before it deleted the key."""

    def is_live(self, now: float, times: LeaseTimes) -> bool:
        """Whether somebody may still hold it. Clocks of other machines play no part."""
        return self.holding is not None and now < self.seen + times.ttl_s


def entry(revision: int, headers: dict[str, str] | None, value: bytes, now: float) -> Entry:
    """The entry of a message of the bucket. One without a valid value is held by nobody."""
    headers = headers or {}
    if "KV-Operation" in headers or "Nats-Marker-Reason" in headers:
        given_back = headers.get("KV-Operation") == "DEL"
        return Entry(revision, None, now, is_given_back=given_back)
    try:
        return Entry(revision, msgspec.json.decode(value, type=Holding), now)
    except MALFORMED_JSON:
        return Entry(revision, None, now)


REQUEST_TIMEOUT_S = 0.9
"""Seconds to wait for an answer of JetStream that is not about a lease."""

OPEN_TIMEOUT_S = 5.0
"""The same while the bucket is made."""

MARKER_TTL_S = 60.0
"""Seconds that the server keeps the mark of a key that has ended."""

WRONG_SEQUENCE = (10071, 10164)
"""Error codes of JetStream: the key has another revision than expected."""

NO_MESSAGE = 10037
"""No message matches."""

OTHER_SETTINGS = 10058
"""The stream exists with other settings."""

NOT_CLUSTERED = 10074
"""The server is alone, and has no room for replicas."""

MAX_ENTRY_BYTES = 64 * 1024
"""The size limit of an entry in bytes."""


class NotALeaseBucket(Exception):
    """The bucket has other settings. Another attempt can't change that."""


class Outdated(Exception):
    """A key has another revision than expected."""


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


async def create_stream(jetstream: JetStreamContext, config: StreamConfig, replicas: int) -> None:
    """Makes a stream, unless another node has just made it; on one server, with one replica.

    Raises the errors of nats-py.
    """
    try:
        await jetstream.add_stream(config, num_replicas=replicas)
    except APIError as error:
        if error.err_code == NOT_CLUSTERED and replicas > 1:
            await create_stream(jetstream, config, 1)
        elif error.err_code != OTHER_SETTINGS:
            raise


class KeyBucket:
    """Keys over one connection. Every change names the revision that it replaces."""

    def __init__(
        self, client: Client, name: str, request_timeout_s: float, key_timeout_s: float
    ) -> None:
        """`key_timeout_s` applies to requests about one key, `request_timeout_s` to all others."""
        self.name = name
        self.client = client
        self._request_timeout_s = request_timeout_s
        self._stream = f"KV_{name}"
        self._subject_prefix = f"$KV.{name}."
        self._key_timeout_s = key_timeout_s
        self._opening = asyncio.Lock()
        self._inbox: str | None = None
        self._numbers = itertools.count()
        self._waiting: dict[str, asyncio.Future[Msg]] = {}
        self.following: JetStreamContext.PushSubscription | None = None

    async def info(self) -> StreamInfo:
        """Returns what the server says of the bucket. Raises the errors of nats-py."""
        jetstream = self.client.jetstream(timeout=self._request_timeout_s)
        return await jetstream.stream_info(self._stream)

    async def make(
        self, replicas: int, after: int, timeout_s: float | None = None, **settings: Any
    ) -> StreamInfo:
        """Returns `info`; makes the bucket, if there is none, with revisions after that one."""
        jetstream = self.client.jetstream(timeout=timeout_s or self._request_timeout_s)
        try:
            # The short timeout: a request made while the stream has no leader is never answered.
            return await self.info()
        except NotFoundError:
            config = StreamConfig(
                name=self._stream,
                subjects=[f"{self._subject_prefix}>"],
                max_msgs_per_subject=1,
                storage=StorageType.FILE,
                deny_delete=True,
                allow_rollup_hdrs=True,
                allow_direct=True,
                first_seq=first_revision(after),
                **settings,
            )
            await create_stream(jetstream, config, replicas)
            return await jetstream.stream_info(self._stream)

    async def allow_ttls(self, config: StreamConfig) -> None:
        """Lets keys of a bucket with these settings have a TTL. Raises the errors of nats-py."""
        jetstream = self.client.jetstream(timeout=self._request_timeout_s)
        await jetstream.update_stream(replace(config, allow_msg_ttl=True))

    async def publish(self, key: str, value: bytes, revision: int, headers: dict[str, str]) -> int:
        """Replaces the revision of a key, 0 if there is none. Returns the new revision.

        Raises `Outdated` and the errors of nats-py.
        """
        expected = {"Nats-Expected-Last-Subject-Sequence": str(revision)}
        answer = await self._request(f"{self._subject_prefix}{key}", value, headers | expected)
        if (answer.headers or {}).get("Status") == "503":
            raise NoStreamResponseError
        ack = msgspec.json.decode(answer.data, type=_Ack)
        if ack.error is None:
            return ack.seq
        if ack.error.get("err_code") in WRONG_SEQUENCE:
            raise Outdated(key)
        APIError.from_error(ack.error)  # Raises the error of that code.
        raise AssertionError("it was raised")

    async def _request(self, subject: str, value: bytes, headers: dict[str, str]) -> Msg:
        """Publishes a message, and waits for its answer.

        This is what `request` of nats-py does, for a fifth of its cost: a node renews hundreds of
        leases every second. Raises `ServerError` if this node may not publish to the subject, and
        `NoAnswer`.
        """
        async with self._opening:
            if self._inbox is None:
                inbox = self.client.new_inbox()
                await self.client.subscribe(f"{inbox}.*", cb=self._answered)
                self._inbox = inbox
        number = str(next(self._numbers))
        answered: asyncio.Future[Msg] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answered
        before = self.client.last_error
        try:
            reply = f"{self._inbox}.{number}"
            await self.client.publish(subject, value, reply=reply, headers=headers)
            async with asyncio.timeout(self._key_timeout_s):
                return await answered
        except TimeoutError:
            error, quoted = self.client.last_error, as_quoted(subject)
            is_new = error is not before
            if is_new and isinstance(error, ServerError) and error.subject == quoted:
                raise error from None
            raise NoAnswer from None
        finally:
            del self._waiting[number]

    async def _answered(self, message: Msg) -> None:
        waiting = self._waiting.get(message.subject.rpartition(".")[2])
        if waiting is not None and not waiting.done():
            waiting.set_result(message)

    async def last(self, key: str) -> RawStreamMsg | None:
        """Reads a key; `None` if it has no value. Raises the errors of nats-py."""
        jetstream = self.client.jetstream(timeout=self._key_timeout_s)
        try:
            return await jetstream.get_last_msg(self._stream, f"{self._subject_prefix}{key}")
        except NotFoundError:
            return None

    async def newer(self, key: str, revision: int) -> RawStreamMsg | None:
        """Reads a key; `None` if it has no later revision. Raises the errors of nats-py."""
        jetstream = self.client.jetstream(timeout=self._key_timeout_s)
        subject = f"{self._subject_prefix}{key}"
        try:
            return await jetstream.get_msg(self._stream, revision + 1, subject, next=True)
        except NotFoundError as error:
            if error.err_code == NO_MESSAGE:
                return None
            raise  # The bucket is gone.

    async def follow_keys(
        self,
        keys: str,
        take: Callable[[str, Msg], None],
        caught_up: Callable[[], None],
        **settings: Any,
    ) -> None:
        """Passes on all keys, and then their changes, until `unfollow`.

        Calls `caught_up` once all present keys were passed on. Raises the errors of nats-py.
        """

        async def taken(message: Msg) -> None:
            take(message.subject.removeprefix(self._subject_prefix), message)
            if not message.metadata.num_pending:
                caught_up()

        config = ConsumerConfig(
            deliver_policy=DeliverPolicy.LAST_PER_SUBJECT,
            ack_policy=AckPolicy.NONE,
            mem_storage=True,
            inactive_threshold=30.0,
            **settings,
        )
        jetstream = self.client.jetstream(timeout=self._request_timeout_s)
        following = self.following = await jetstream.subscribe(
            f"{self._subject_prefix}{keys}", stream=self._stream, config=config, cb=taken
        )
        try:
            info = await following.consumer_info()
        except Exception:
            # The caller may use another bucket next.
            with contextlib.suppress(Error, OSError):
                await self.unfollow()
            raise
        if not info.num_pending and not (info.delivered and info.delivered.consumer_seq):
            # The bucket is empty: no message will report `num_pending` 0.
            caught_up()

    async def unfollow(self) -> None:
        """Ends `follow_keys`."""
        following, self.following = self.following, None
        if following is not None:
            await following.unsubscribe()


class LeaseBucket(KeyBucket):
    """A bucket of leases."""

    def __init__(self, client: Client, name: str, times: LeaseTimes = LEASE_TIMES) -> None:
        super().__init__(client, name, REQUEST_TIMEOUT_S, times.answer_timeout_s)
        self._times = times

    async def open(self, replicas: int = 1, after: int = 0) -> tuple[datetime | None, int]:
        """Makes the bucket, if there is none, with revisions after that one.

        Returns when it was made, and its last revision. One of the same name may have been lost,
        or deleted. Raises `NotALeaseBucket` and the errors of nats-py.
        """
        info = await self.make(
            replicas,
            after,
            OPEN_TIMEOUT_S,
            max_msg_size=MAX_ENTRY_BYTES,
            discard=DiscardPolicy.NEW,
            allow_msg_ttl=True,
            subject_delete_marker_ttl=MARKER_TTL_S,
        )
        found = info.config
        if not found.allow_msg_ttl or found.max_msgs_per_subject != 1:
            raise NotALeaseBucket(await self._flaw())
        return info.created, info.state.last_seq

    async def _flaw(self) -> str:
        """Why this is no bucket of leases. Raises the errors of nats-py."""
        flaw = f"the bucket {self.name} exists without TTLs of keys or with a history"
        jetstream = self.client.jetstream(timeout=REQUEST_TIMEOUT_S)
        found = await jetstream.stream_info(self._stream, subjects_filter=">")
        subjects = sorted(found.state.subjects or ())
        if not subjects:
            return f"{flaw}: delete it, so that it is made again"
        example = quote(subjects[-1].removeprefix(self._subject_prefix))
        return (
            f"{flaw}, and has {counted(len(subjects), 'key')}, such as {example}: another log or "
            "program may need it, so delete it only if nothing does"
        )

    async def settle(self) -> Entry:
        """Marks the bucket as old enough for leases to be taken, see `SETTLED`.

        Raises as `put` does.
        """
        revision = await self.publish(SETTLED, b"{}", 0, {})
        return Entry(revision, None, time.monotonic())

    async def put(self, key: str, value: bytes, revision: int) -> int:
        """Replaces the revision of a key, 0 if there is none, until its TTL ends.

        Returns the new revision. Raises `Outdated` and the errors of nats-py.
        """
        ttl = {"Nats-TTL": f"{self._times.server_ttl_s}s"}
        return await self.publish(key, value, revision, ttl)

    async def delete(self, key: str, revision: int, *, is_clean: bool = True) -> None:
        """Deletes a key. Raises as `put` does.

        With `is_clean`, nothing that this or an earlier holder has sent can still be in flight: the
        next holder may use the lease at once. Otherwise it waits first.
        """
        operation = "DEL" if is_clean else "PURGE"
        headers = {"KV-Operation": operation, "Nats-TTL": f"{MARKER_TTL_S:.0f}s"}
        await self.publish(key, b"", revision, headers)

    async def get(self, key: str) -> Entry | None:
        """Reads a key. Raises the errors of nats-py."""
        found = await self.last(key)
        if found is None:
            return None
        return entry(found.seq or 0, found.headers, found.data or b"", time.monotonic())

    async def follow(
        self, take: Callable[[str, Entry], None], caught_up: Callable[[], None]
    ) -> None:
        """Passes on all keys, and then their changes, see `follow_keys`."""

        def taken(key: str, message: Msg) -> None:
            revision, now = message.metadata.sequence.stream, time.monotonic()
            take(key, entry(revision, message.headers, message.data, now))

        await self.follow_keys(">", taken, caught_up, num_replicas=1)
