"""A bucket of keys in JetStream: makes it, changes keys by compare-and-set, and follows them.

`KeyValue` of nats-py can't renew a key with a TTL, and its `create` is late to find a key that the
server has deleted. Here every change names the revision that it replaces.

It is for buckets with the leases and the state of nodes of Holdfast, and passes on each message at
once: a late renewal would end a lease. Its users decide when to follow the keys anew, and what a
lost bucket means. For buckets that other programs write, `scanner.jetstream.key_watch` decides
both, and waits until changes have settled.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import msgspec
from nats.errors import Error
from nats.errors import TimeoutError as NoAnswer
from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy, StorageType, StreamConfig
from nats.js.errors import APIError, NoStreamResponseError, NotFoundError

from holdfast.net.nats.jetstream_errors import (
    NO_MESSAGE,
    NOT_CLUSTERED,
    STREAM_EXISTS,
    WRONG_SEQUENCE,
)
from holdfast.net.nats.tolerant_client import ServerError, as_quoted

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext
    from nats.js.api import RawStreamMsg, StreamInfo

OPERATION_HEADER = "KV-Operation"
"""The header with which a client deletes a key: `DEL` or `PURGE`."""

_MARKER_HEADERS = (OPERATION_HEADER, "Nats-Marker-Reason")
"""The headers of messages that stand for deleted or expired keys."""


class Outdated(Exception):
    """A key has another revision than expected."""


class _Ack(msgspec.Struct):
    """The answer of JetStream to a message."""

    seq: int = 0
    error: dict[str, Any] | None = None


def is_marker(headers: Mapping[str, str]) -> bool:
    """Whether a message with these headers stands for a deleted or expired key."""
    return any(header in headers for header in _MARKER_HEADERS)


def first_revision(last_revision: int) -> int:
    """Where the revisions of a new bucket begin: after those of a lost one of the same name.

    Who compares them, such as a consumer of values, may know only the lost one. No bucket has a
    million changes a second, so the time in microseconds is later, if the clock is right now and
    was when the lost one was made.
    """
    return max(last_revision + 1, time.time_ns() // 1000)


async def create_stream(jetstream: JetStreamContext, config: StreamConfig, replicas: int) -> None:
    """Makes a stream, unless another node has just made it; on one server, with one replica.

    Raises the errors of nats-py.
    """
    try:
        await jetstream.add_stream(config, num_replicas=replicas)
    except APIError as error:
        if error.err_code == NOT_CLUSTERED and replicas > 1:
            await create_stream(jetstream, config, 1)
        elif error.err_code != STREAM_EXISTS:
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
        self, replicas: int, last_revision: int, timeout_s: float | None = None, **settings: Any
    ) -> StreamInfo:
        """Returns `info`; makes the bucket, if there is none, with revisions after the last one.

        `timeout_s` applies to that.
        """
        jetstream = self.client.jetstream(timeout=timeout_s or self._request_timeout_s)
        try:
            # `info` has its own, shorter timeout: what is asked while the stream has no leader is
            # never answered.
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
                first_seq=first_revision(last_revision),
                **settings,
            )
            await create_stream(jetstream, config, replicas)
            return await jetstream.stream_info(self._stream)

    async def allow_ttls(self, config: StreamConfig) -> StreamConfig:
        """Lets keys of a bucket with these settings have a TTL. Returns the new settings.

        Raises the errors of nats-py.
        """
        jetstream = self.client.jetstream(timeout=self._request_timeout_s)
        return (await jetstream.update_stream(replace(config, allow_msg_ttl=True))).config

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
