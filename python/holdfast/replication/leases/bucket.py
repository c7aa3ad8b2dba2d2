"""A bucket of leases: makes it, takes, renews and deletes leases, and follows all of them."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
from nats.js.api import DiscardPolicy

from holdfast.net.nats.key_bucket import OPERATION_HEADER, KeyBucket, is_marker
from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from holdfast.runtime.malformed_json import MALFORMED_JSON
from holdfast.runtime.text import counted, quote

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from nats.aio.client import Client
    from nats.aio.msg import Msg

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
    if is_marker(headers):
        given_back = headers.get(OPERATION_HEADER) == "DEL"
        return Entry(revision, None, now, is_given_back=given_back)
    try:
        return Entry(revision, msgspec.json.decode(value, type=Holding), now)
    except MALFORMED_JSON:
        return Entry(revision, None, now)


REQUEST_TIMEOUT_S = 0.9
"""Seconds to wait for an answer of JetStream that is not about a lease."""

OPEN_TIMEOUT_S = 5.0
"""The same while the bucket is made."""

MIN_SERVER = (2, 11)
"""The first version of nats-server that has TTLs of keys. Older ones make a bucket without them."""

MARKER_TTL_S = 60.0
"""Seconds that the server keeps the mark of a key that has ended."""

MAX_ENTRY_BYTES = 64 * 1024
"""The size limit of an entry in bytes."""


class NotALeaseBucket(Exception):
    """The bucket has other settings. Another attempt can't change that."""


class LeaseBucket(KeyBucket):
    """A bucket of leases."""

    def __init__(self, client: Client, name: str, times: LeaseTimes = LEASE_TIMES) -> None:
        super().__init__(client, name, REQUEST_TIMEOUT_S, times.answer_timeout_s)
        self._times = times

    async def open(self, replicas: int = 1, last_revision: int = 0) -> tuple[datetime | None, int]:
        """Makes the bucket, if there is none, with revisions after the last one.

        Returns when it was made, and its last revision. One of the same name may have been lost,
        or deleted. Raises `NotALeaseBucket` and the errors of nats-py.
        """
        info = await self.make(
            replicas,
            last_revision,
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
        server = self.client.connected_server_version
        with contextlib.suppress(TypeError, ValueError):  # As the server says it.
            if (server.major, server.minor) < MIN_SERVER:
                required = ".".join(map(str, MIN_SERVER))
                own = f"{server.major}.{server.minor}.{server.patch}"
                return f"leases require nats-server {required} or newer, and this is {own}"
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
        headers = {OPERATION_HEADER: operation, "Nats-TTL": f"{MARKER_TTL_S:.0f}s"}
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
