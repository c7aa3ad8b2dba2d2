"""What the subscribers of a fleet want: a key for each device, in a bucket."""

from __future__ import annotations

import asyncio
import base64
import contextlib
from typing import TYPE_CHECKING

import msgspec
from nats.errors import Error
from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy, StorageType, StreamConfig
from nats.js.errors import APIError, NotFoundError

from holdfast.leases import Outdated, made
from holdfast.scanner.fleet.terms import FleetRefused, Terms

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.aio.subscription import Subscription
    from nats.js import JetStreamContext

TIMEOUT = 2.0
"""Seconds to wait for an answer of JetStream."""

TERMS = "terms"
DEVICE = "device."

WRONG_SEQUENCE = (10071, 10164)
"""Error codes of JetStream: the key has another revision than expected."""


class Want(msgspec.Struct, kw_only=True):
    """The value of a device: its subscriptions, as requests."""

    requests: list[msgspec.Raw]
    renewed: dict[str, int] = {}
    """Milliseconds since 1970 at which each subscriber with a `ttl` has sent its last request."""


class Wants:
    """The bucket of wants. `changed` is called for each device that has a new value."""

    def __init__(self, fleet: str, changed: Callable[[str], None]) -> None:
        self.bucket = f"holdfast_fleet_{fleet}_wants"
        self._stream = f"KV_{self.bucket}"
        self._pre = f"$KV.{self.bucket}."
        self._changed = changed
        self._client: Client | None = None
        self._following: Subscription | None = None
        self._values: dict[str, tuple[int, bytes]] = {}
        """Revision and value of each device; the value is empty if it was deleted."""
        self.is_read = asyncio.Event()
        """Set when all values that were stored at the start are known."""

    async def open(self, client: Client, terms: Terms, has_nodes: bool) -> None:
        """Makes the bucket, agrees on the terms, and begins to follow the values.

        Raises `FleetRefused` for other terms than those of the live nodes, and errors of nats-py.
        """
        self._client = client
        await self._make(client.jetstream(timeout=TIMEOUT))
        await self._agree(terms, has_nodes)
        if self._following is not None:
            with contextlib.suppress(Error):
                await self._following.unsubscribe()
        config = ConsumerConfig(
            deliver_policy=DeliverPolicy.LAST_PER_SUBJECT,
            ack_policy=AckPolicy.NONE,
            mem_storage=True,
            inactive_threshold=30.0,
        )
        context = client.jetstream(timeout=TIMEOUT)
        following = await context.subscribe(
            f"{self._pre}{DEVICE}>", stream=self._stream, config=config, cb=self._saw
        )
        self._following = following
        info = await following.consumer_info()
        if not info.num_pending and not (info.delivered and info.delivered.consumer_seq):
            self.is_read.set()

    async def _make(self, context: JetStreamContext) -> None:
        try:
            await context.stream_info(self._stream)
        except NotFoundError:
            config = StreamConfig(
                name=self._stream,
                subjects=[f"{self._pre}>"],
                max_msgs_per_subject=1,
                storage=StorageType.FILE,
                deny_delete=True,
                allow_rollup_hdrs=True,
                allow_direct=True,
            )
            await made(context, config, 3)

    async def _agree(self, terms: Terms, has_nodes: bool) -> None:
        """The first node decides the terms; while there are none, another one may."""
        value = msgspec.json.encode(terms)
        while True:
            revision, found = await self._get(TERMS)
            if found:
                try:
                    difference = terms.difference(msgspec.json.decode(found, type=Terms))
                except msgspec.DecodeError:
                    difference = "the protocol is another one"
                if difference is None:
                    return
                if has_nodes:
                    raise FleetRefused(difference)
            with contextlib.suppress(Outdated):
                await self._put(TERMS, value, revision)
                return

    def value(self, device: str) -> tuple[int, Want | None]:
        """The last known revision and value of a device; `None` if nobody wants it."""
        revision, value = self._values.get(device, (0, b""))
        return revision, msgspec.json.decode(value, type=Want) if value else None

    @property
    def devices(self) -> list[str]:
        """All devices that somebody wants."""
        return [device for device, (_, value) in self._values.items() if value]

    async def store(self, device: str, want: Want | None, revision: int) -> int:
        """Replaces that revision of a device. Returns the new one.

        Raises `Outdated` and errors of nats-py.
        """
        value = b"" if want is None else msgspec.json.encode(want)
        stored = await self._put(DEVICE + _token(device), value, revision)
        self._know(device, stored, value)
        return stored

    async def read(self, device: str) -> None:
        """Reads the value of a device anew. Raises errors of nats-py."""
        revision, value = await self._get(DEVICE + _token(device))
        self._know(device, revision, value)

    def _know(self, device: str, revision: int, value: bytes) -> bool:
        if revision <= self._values.get(device, (0, b""))[0]:
            return False
        self._values[device] = (revision, value)
        return True

    async def _saw(self, message: Msg) -> None:
        metadata = message.metadata
        with contextlib.suppress(ValueError):
            device = _text(message.subject.removeprefix(self._pre + DEVICE))
            if self._know(device, metadata.sequence.stream, message.data):
                self._changed(device)
        if metadata.num_pending == 0:
            self.is_read.set()

    async def _get(self, key: str) -> tuple[int, bytes]:
        assert self._client is not None, "the bucket is open"
        context = self._client.jetstream(timeout=TIMEOUT)
        try:
            found = await context.get_last_msg(self._stream, f"{self._pre}{key}")
        except NotFoundError:
            return 0, b""
        return found.seq or 0, found.data or b""

    async def _put(self, key: str, value: bytes, revision: int) -> int:
        assert self._client is not None, "the bucket is open"
        headers = {"Nats-Expected-Last-Subject-Sequence": str(revision)}
        if not value:
            headers["KV-Operation"] = "DEL"
        context = self._client.jetstream(timeout=TIMEOUT)
        try:
            ack = await context.publish(f"{self._pre}{key}", value, headers=headers)
        except APIError as error:
            if error.err_code in WRONG_SEQUENCE:
                raise Outdated(key) from None
            raise
        return ack.seq


def _token(device: str) -> str:
    """A device id as a part of a key."""
    return base64.urlsafe_b64encode(device.encode()).rstrip(b"=").decode()


def _text(token: str) -> str:
    return base64.urlsafe_b64decode(token + "=" * (-len(token) % 4)).decode()
