"""The subscriptions of a fleet, stored in a bucket: a key for each device."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
from nats.errors import Error

from holdfast.config.values.scanner_settings import WANTS
from holdfast.events import log_lines
from holdfast.net.nats.key_bucket import OPERATION_HEADER, KeyBucket, Outdated
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.scanner.fleet.agreement import FleetRefused, Terms
from holdfast.scanner.jetstream.bucket_ttl import TtlRemoval

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from nats.aio.client import Client
    from nats.aio.msg import Msg

TIMEOUT_S = 2.0
"""Time to wait for an answer of JetStream."""

TERMS = "terms"
DEVICE = "device."

VISIBLE_AFTER_S = 1.0
"""Time in which nodes that start at the same time see each other."""

MAX_CONCURRENT_WRITES = 32
"""Values of a lost bucket that are stored again concurrently."""

DELETION_TTL_S = 3600
"""How long the bucket and the nodes keep a deletion. A node that was away for longer looks for what
the bucket does not have any more."""

FORMER_HEADER = "Holdfast-Former"
"""The header of a value that is from a lost bucket: which one, and its revision there."""


class DesiredDevice(msgspec.Struct, kw_only=True):
    """The value of a device: its subscriptions, as requests."""

    requests: list[msgspec.Raw]
    renewed: dict[str, int] = {}
    """Milliseconds since 1970 at which each subscriber with a `ttl` has sent its last request."""


@dataclass(frozen=True)
class _Former:
    """A value of a lost bucket."""

    bucket: str
    revision: int
    value: bytes

    def header(self) -> str:
        return f"{self.bucket} {self.revision}"

    def replaces(self, header: str) -> bool:
        """Whether another node has stored an older value of the same bucket."""
        bucket, _, revision = header.rpartition(" ")
        return bucket == self.bucket and revision.isdecimal() and int(revision) < self.revision


class DesiredState:
    """The bucket. Each node knows all of it, and stores it again if it gets lost."""

    def __init__(
        self, fleet: str, on_change: Callable[[str], None], on_loss: Callable[[], None]
    ) -> None:
        """`on_change` is called for each device that has a new value.

        `on_loss` is called when all revisions that are known have become void.
        """
        self.bucket = f"holdfast_fleet_{fleet}{WANTS}"
        self._fleet = fleet
        self._on_change = on_change
        self._on_loss = on_loss
        self._bucket: KeyBucket | None = None
        self._ttl = TtlRemoval()
        self._values: dict[str, tuple[int, bytes]] = {}
        """Revision and value of each device; the value is empty if it was deleted."""
        self._latest = 0
        """The latest revision that is known."""
        self._deleted: dict[str, float] = {}
        """When this node has learned of each deletion, the oldest first."""
        self._doubted: set[str] = set()
        """The devices that the bucket may not have any more, as the deletion has ended there."""
        self._is_shown = False
        """Whether the bucket has shown all that it has, since it is followed."""
        self.made_at = ""
        """When the bucket was made: another one of this name was made at another time."""
        self._former: dict[str, _Former] = {}
        """The values of a lost bucket that are not stored again yet."""
        self.is_read = asyncio.Event()
        """Set when all values that were stored at the start are known."""

    async def open(
        self,
        client: Client,
        terms: Terms,
        is_in_force: Callable[[bytes], bool],
        *,
        has_joined: bool,
    ) -> None:
        """Makes the bucket, agrees on the terms, and begins to follow the values.

        Raises `FleetRefused` if other terms are in force, and errors of nats-py.
        """
        if self._bucket is None or self._bucket.client is not client:
            self._bucket = KeyBucket(client, self.bucket, TIMEOUT_S, TIMEOUT_S)
        found = await self._bucket.make(3, self._latest, allow_msg_ttl=True)
        config = found.config
        if not config.allow_msg_ttl:  # Before deletions had an end.
            config = await self._bucket.allow_ttls(config)
        await self._ttl.remove(client, config)
        self._identify(str(found.created), found.state.last_seq)
        await self.agree(terms, is_in_force, may_replace=has_joined)
        await self._restore()
        with contextlib.suppress(Error):
            await self._bucket.unfollow()
        self._doubted, self._is_shown = set(self._values), False
        await self._bucket.follow_keys(f"{DEVICE}>", self._on_message, self._on_shown)

    def _on_shown(self) -> None:
        self._is_shown = True
        self.is_read.set()

    def _identify(self, made_at: str, last: int) -> None:
        """Notes that the bucket is another one, or was set back, and that its values are lost."""
        before, self.made_at = self.made_at, made_at
        if not before or (before == made_at and last >= self._latest):
            return
        self._former |= {
            device: _Former(before, revision, value)
            for device, (revision, value) in self._values.items()
        }
        self._values, self._deleted, self._latest = {}, {}, 0
        self._on_loss()
        known = sum(bool(former.value) for former in self._former.values())
        fields = {"fleet": self._fleet, "bucket": self.bucket, "devices": known}
        log_lines.write(logging.WARNING, "fleet_storage_lost", **fields)

    async def _restore(self) -> None:
        """Stores what a lost bucket had. Raises errors of nats-py."""
        if not self._former:
            return
        stored, left = 0, list(self._former)
        while left:
            batch, left = left[:MAX_CONCURRENT_WRITES], left[MAX_CONCURRENT_WRITES:]
            # All must have ended before an error is raised: it starts another attempt.
            works = map(self._restore_one, batch)
            for outcome in await asyncio.gather(*works, return_exceptions=True):
                if isinstance(outcome, BaseException):
                    raise outcome
                stored += outcome
        fields = {"fleet": self._fleet, "bucket": self.bucket, "devices": stored}
        log_lines.write(logging.INFO, "subscriptions_restored", **fields)

    async def _restore_one(self, device: str) -> bool:
        """Returns whether subscriptions were stored. A newer value stays as it is."""
        former, key = self._former[device], DEVICE + _token(device)
        is_stored, revision = False, 0
        while not is_stored:
            try:
                await self._put(key, former.value, revision, {FORMER_HEADER: former.header()})
                is_stored = True
            except Outdated:
                assert self._bucket is not None, "it is open"
                found = await self._bucket.last(key)
                header = "" if found is None else (found.headers or {}).get(FORMER_HEADER, "")
                if found is None or not former.replaces(header):
                    break
                revision = found.seq or 0
        del self._former[device]
        return is_stored and bool(former.value)

    async def is_followed(self) -> bool:
        """Whether changes of the bucket still arrive. Raises errors of nats-py.

        Removes a TTL that the bucket was given meanwhile.
        """
        bucket = self._bucket
        if bucket is None or bucket.following is None:
            return False
        info = await bucket.info()
        if str(info.created) != self.made_at or info.state.last_seq < self._latest:
            return False
        await self._ttl.remove(bucket.client, info.config)
        await bucket.following.consumer_info()  # Its server may have ended.
        return True

    async def agree(
        self, terms: Terms, is_in_force: Callable[[bytes], bool], *, may_replace: bool
    ) -> None:
        """The first node decides the terms. Others replace those of nodes that have ended.

        `is_in_force` returns whether a live node has these terms. `may_replace` is true once others
        see this node: two may start at once. Raises `FleetRefused` if other terms are in force.
        """
        value, has_waited = terms.encoded(), False
        while True:
            revision, found = await self._get(TERMS)
            if found:
                try:
                    difference = terms.difference(msgspec.json.decode(found, type=Terms))
                except MALFORMED_JSON:
                    difference = "the protocol is another one"
                if difference is None:
                    return
                if is_in_force(found):
                    raise FleetRefused(difference)
                if not may_replace:
                    return
                if not has_waited:
                    await asyncio.sleep(VISIBLE_AFTER_S)
                    has_waited = True
                    continue
            with contextlib.suppress(Outdated):
                await self._put(TERMS, value, revision)
                return

    def revision(self, device: str) -> int:
        """The last known revision of a device; 0 if none is known."""
        return self._values.get(device, (0, b""))[0]

    def value(self, device: str) -> tuple[int, DesiredDevice | None]:
        """The last known revision and value of a device; `None` without subscriptions."""
        revision, value = self._values.get(device, (0, b""))
        return revision, msgspec.json.decode(value, type=DesiredDevice) if value else None

    @property
    def devices(self) -> list[str]:
        """All devices with subscriptions."""
        return [device for device, (_, value) in self._values.items() if value]

    async def store(self, device: str, desired: DesiredDevice | None, revision: int) -> int:
        """Replaces `revision` of a device. Returns the new one.

        Raises `Outdated` and errors of nats-py.
        """
        value, made_at = b"" if desired is None else msgspec.json.encode(desired), self.made_at
        try:
            stored = await self._put(DEVICE + _token(device), value, revision)
        except Outdated:
            self._doubted.add(device)
            raise
        if made_at != self.made_at:
            raise Outdated(device)
        self._learn(device, stored, value)
        return stored

    async def read(self, device: str) -> None:
        """Reads the value of a device, if it is another one than the known one.

        Raises errors of nats-py.
        """
        assert self._bucket is not None, "it is open"
        key, known = DEVICE + _token(device), self.revision(device)
        is_doubted = device in self._doubted
        # A value may be large, so it is not read again without need.
        found = await (self._bucket.last(key) if is_doubted else self._bucket.newer(key, known))
        if found is not None:
            self._learn(device, found.seq or 0, found.data or b"")
        elif is_doubted and self.revision(device) == known:
            self._forget(device)

    async def forget_ended(self) -> None:
        """Forgets the devices whose deletion has ended. Raises errors of nats-py."""
        if self._is_shown:
            for device in tuple(self._doubted):
                await self.read(device)
        before = time.monotonic() - DELETION_TTL_S
        for device in [device for device, at in self._deleted.items() if at < before]:
            self._forget(device)

    def _forget(self, device: str) -> None:
        self._values.pop(device, None)
        self._deleted.pop(device, None)
        self._doubted.discard(device)
        self._on_change(device)

    def _learn(self, device: str, revision: int, value: bytes) -> bool:
        self._doubted.discard(device)
        if revision <= self.revision(device):
            return False
        self._values[device] = (revision, self._checked(device, value))
        self._latest = max(self._latest, revision)
        self._deleted.pop(device, None)
        if not value:
            self._deleted[device] = time.monotonic()
        return True

    def _checked(self, device: str, value: bytes) -> bytes:
        """The value; a malformed one is logged, and counts as one without subscriptions."""
        try:
            if value:
                msgspec.json.decode(value, type=DesiredDevice)
        except MALFORMED_JSON as error:
            fields = {"bucket": self.bucket, "key": DEVICE + _token(device)}
            reason = malformed_text(error, value)
            log_lines.refused("kept_entry_malformed", kind="fleet", **fields, reason=reason)
            return b""
        return value

    def _on_message(self, key: str, message: Msg) -> None:
        with contextlib.suppress(ValueError):
            device = _text(key.removeprefix(DEVICE))
            if self._learn(device, message.metadata.sequence.stream, message.data):
                self._on_change(device)

    async def _get(self, key: str) -> tuple[int, bytes]:
        assert self._bucket is not None, "it is open"
        found = await self._bucket.last(key)
        return (0, b"") if found is None else (found.seq or 0, found.data or b"")

    async def _put(
        self, key: str, value: bytes, revision: int, more: Mapping[str, str] | None = None
    ) -> int:
        assert self._bucket is not None, "it is open"
        headers = dict(more or {})
        if not value:
            headers |= {OPERATION_HEADER: "DEL", "Nats-TTL": f"{DELETION_TTL_S}s"}
        return await self._bucket.publish(key, value, revision, headers)


def _token(device: str) -> str:
    """A device id as a part of a key."""
    return base64.urlsafe_b64encode(device.encode()).rstrip(b"=").decode()


def _text(token: str) -> str:
    return base64.urlsafe_b64decode(token + "=" * (-len(token) % 4)).decode()
