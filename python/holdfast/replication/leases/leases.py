"""Holds leases: takes those that are free, renews them, and gives them back.

Two clocks are never compared. A holder stops `hold_s` after it *sent* its last renewal; all others
wait until they have not seen a renewal for `ttl_s`, which is longer, and then replace exactly the
revision that they have seen. If it was renewed meanwhile, that fails. So it does not matter when
the server deletes a key, whether a message about it is late, or how long a process was stopped.

One event loop changes leases; what is held, and by whom, may be read from every thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import secrets
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import msgspec
from nats.errors import Error
from nats.errors import TimeoutError as NoAnswer
from nats.js.errors import APIError, NoStreamResponseError

from holdfast import _core
from holdfast.net.nats.connection import nats_reason
from holdfast.net.nats.key_bucket import Outdated
from holdfast.net.nats.tolerant_client import ServerError
from holdfast.replication.leases.bucket import (
    SETTLED,
    Entry,
    Holding,
    LeaseBucket,
    NotALeaseBucket,
)
from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from holdfast.runtime import tasks
from holdfast.runtime.backoff import Backoff

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Mapping
    from datetime import datetime

    from nats.aio.client import Client

TICK_S = 0.1
"""The longest time between two looks at what others hold."""

SILENT_RENEWALS = 2.5
"""Renewals without news, while they are confirmed, after which keys are followed anew."""

FIRST_RETRY_S = 0.5
MAX_RETRY_S = 2.0
"""The pauses after failures to open the bucket. All nodes notice at the same time that it works."""

USE_CHECK_S = 0.01
"""Between looks at a lease that is being given back."""


def lease_number(key: str) -> int:
    """The number of a lease in the steps of a log, the same on all nodes."""
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:8])


class Watcher(Protocol):
    """Receives changes, in the event loop that changes leases."""

    def taken(self, key: str) -> None:
        """A lease was taken."""

    def lost(self, key: str, reason: str) -> None:
        """A lease is not held any more, though it was wanted."""

    def changed(self) -> None:
        """Somebody else has taken or left a lease."""

    def availability_changed(self, reason: str | None) -> None:
        """The bucket works; or it does not, for this reason."""


@dataclass
class _Held:
    """A lease that this process holds."""

    revision: int
    holding: Holding
    since: int
    """The revision with which it was taken. It grows with each holder."""
    until: float
    """When it must not be used any more."""
    is_late: bool = False
    """Whether the last renewal was not confirmed."""
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Held while the key is being written."""


class Leases:
    """The leases of one bucket, as one process holds them, from `run` to its end."""

    def __init__(
        self,
        bucket: str,
        node: str,
        watcher: Watcher,
        *,
        times: LeaseTimes = LEASE_TIMES,
        replicas: int = 1,
        about: Callable[[str], dict[str, Any]] = lambda _: {},
        withheld: Callable[[], str | None] = lambda: None,
    ) -> None:
        """`about` returns what the value of a lease says besides its holder, at each renewal.

        `withheld` returns why leases are not renewed or taken now; `None` if they are.
        """
        self.node = node
        self.process = secrets.token_hex(8)
        self.seen: dict[str, Entry] = {}
        """All keys of the bucket, as last seen."""
        self.is_read = False
        """Whether all keys are known that there were at the start."""
        self.bucket = bucket
        self.times = times
        self._watcher = watcher
        self._withheld = withheld
        self._replicas = replicas
        self._about = about
        self._fences: dict[str, _core.Fence] = {}
        self._held: dict[str, _Held] = {}
        self._wanted: frozenset[str] = frozenset()
        self._taking: set[str] = set()
        self._returning_keys: set[str] = set()
        """Those that are being given back."""
        self._client: Client | None = None
        self._bucket: LeaseBucket | None = None
        self.reason: str | None = "not connected"
        """Why the bucket does not work; `None` if it does."""
        self._is_opening = self._is_settling = False
        self._is_followed = False
        """Whether the keys of the bucket are followed over this connection, as far as is known."""
        self._refusal: Exception | None = None
        """Why the last write was refused, if it may still be so."""
        self._backoff = Backoff(FIRST_RETRY_S, MAX_RETRY_S, jitter=True)
        self._made_at: datetime | None = None
        self.may_settle_at = 0.0
        self._news = asyncio.Event()
        self._heard = self._acknowledged = 0.0
        self._tasks: set[asyncio.Task[None]] = set()

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._client = client
        if client is not None and isinstance(self._refusal, ServerError):
            self._refusal = None  # Permissions may have changed.
        if client is not None and self._bucket is not None and self._bucket.client is not client:
            self._bucket = None
        self._is_followed = False  # The server may have forgotten who follows, or what is stored.
        self._news.set()

    def fence(self, key: str) -> _core.Fence:
        """The fence of what a lease protects. It stays the same while the lease comes and goes."""
        return self._fences.setdefault(key, _core.Fence(lease_number(key)))

    def want(self, keys: Iterable[str]) -> None:
        """Takes these leases as soon as they are free. Others are kept until `give_back`."""
        self._wanted = frozenset(keys)
        self._news.set()

    @property
    def held(self) -> Mapping[str, int]:
        """The leases that are held, with the revision with which each was taken."""
        return {key: held.since for key, held in self._held.copy().items()}

    def since(self, key: str) -> int:
        """The revision with which a lease that is held was taken; 0 of another one."""
        held = self._held.get(key)
        return 0 if held is None else held.since

    def revision(self, key: str) -> int:
        """The latest revision of a lease that is held; 0 of another one."""
        held = self._held.get(key)
        return 0 if held is None else held.revision

    def is_held(self, key: str) -> bool:
        """Whether what the lease protects may be used now. Ask at the last moment."""
        return key in self._held and self._fences[key].allows

    def holder(self, key: str) -> Holding | None:
        """Who holds a lease, as far as is known."""
        if (own := self._held.get(key)) is not None:
            return own.holding
        entry, now = self.seen.get(key), time.monotonic()
        return entry.holding if entry is not None and entry.is_live(now, self.times) else None

    async def run(self) -> None:
        """Holds what is wanted, until it is cancelled."""
        due = 0.0
        try:
            while True:
                now = time.monotonic()
                self._check_bucket(now)
                withheld = self._withheld()
                self._note_lapsed(now, withheld or "it could not be renewed")
                is_due = now >= due
                if is_due:
                    # What is withheld for a moment is renewed as soon as it is not.
                    due = now + (self.times.renewal_s if withheld is None else TICK_S)
                if withheld is None:
                    for key, held in self._held.items():
                        if is_due or held.is_late:
                            self._begin(self._renew(key, held))
                    self._take_free(now)
                await tasks.within(min(TICK_S, max(due - now, 0.0)), self._news.wait())
                self._news.clear()
        except Exception:
            for key in self._held.copy():
                self._give_up(key, "an internal error")
            raise
        finally:
            for task in self._tasks:
                task.cancel()
            self._taking.clear()
            self._is_opening = self._is_settling = False
            for fence in self._fences.copy().values():
                fence.close()

    async def renew_now(self, key: str) -> None:
        """Renews a lease at once, so that others see what it says now."""
        held = self._held.get(key)
        if held is not None:
            await self._renew(key, held)

    async def give_back(self, key: str, limit: float) -> bool:
        """Gives a lease back when all polls and writes have ended, or after `limit` seconds.

        Returns whether all had ended. Nothing new begins meanwhile, and the lease is renewed.
        """
        held = self._held.get(key)
        if held is None:
            return True
        fence = self._fences[key]
        self._returning_keys.add(key)
        try:
            fence.end()
            until = time.monotonic() + limit
            while fence.in_use and time.monotonic() < until and key in self._held:
                await asyncio.sleep(USE_CHECK_S)
            is_clean = fence.in_use == 0
            fence.close()
            async with held.lock:
                if self._held.pop(key, None) is None:
                    return False
                if is_clean and self._bucket is not None:
                    # Without the mark, others wait until the lease has ended.
                    with contextlib.suppress(Outdated, Error, OSError):
                        await self._bucket.delete(key, held.revision)
            return is_clean
        finally:
            self._returning_keys.discard(key)
            self._watcher.changed()

    async def give_all_back(self, limit: float) -> None:
        """Gives back all leases that are held or being taken, as `give_back` does.

        Nothing may be wanted any more.
        """
        while self._held or self._taking:
            returned = (self.give_back(key, limit) for key in self._held.copy())
            await asyncio.gather(*returned, return_exceptions=True)
            if self._taking:
                await asyncio.sleep(USE_CHECK_S)

    def _check_bucket(self, now: float) -> None:
        """Opens the bucket at first, after each connect, and when nothing is seen of it.

        It may be another one than before. Renewals go on meanwhile.
        """
        if self._client is None or self._is_opening:
            return
        silence_s = SILENT_RENEWALS * self.times.renewal_s
        if self._bucket is not None and now - self._heard > silence_s:
            is_missing = any(key not in self._held for key in self._wanted)
            if is_missing or now - self._acknowledged < silence_s:
                self._is_followed = False
        if not self._is_followed:
            self._is_opening = True
            self._begin(self._open(self._client))

    async def _open(self, client: Client) -> None:
        bucket = self._bucket or LeaseBucket(client, self.bucket, self.times)
        try:
            created, last_revision = await bucket.open(self._replicas, self._latest)
            await bucket.unfollow()
            self._identify(created, last_revision)
            await bucket.follow(self._saw, self._note_read)
        except (Error, OSError, NotALeaseBucket) as error:
            self.set_reason(nats_reason(error))
            await asyncio.sleep(self._backoff.failed())
            return
        finally:
            self._is_opening = False
        if self._client is not client:
            with contextlib.suppress(Error, OSError):
                await bucket.unfollow()
            return
        self._bucket = bucket
        self._is_followed = True
        self._heard = time.monotonic()
        self._backoff.succeeded()
        if self._refusal is None:
            self.set_reason(None)
        self._news.set()

    def _identify(self, created: datetime | None, last_revision: int) -> None:
        """Forgets what is known of a bucket that is lost, or was set back: revisions begin anew."""
        if created != self._made_at or last_revision < self._latest:
            self._made_at = created
            self.seen.clear()
            self.is_read, self._refusal = False, None
            self.may_settle_at = time.monotonic() + self.times.settle_s

    @property
    def _latest(self) -> int:
        """The latest revision of all keys."""
        return max((entry.revision for entry in self.seen.copy().values()), default=0)

    def _note_read(self) -> None:
        self.is_read = True

    def set_reason(self, reason: str | None) -> None:
        """Sets why the bucket does not work; `None` if it does."""
        if reason != self.reason:
            self.reason = reason
            self._watcher.availability_changed(reason)

    def _note_failure(self, error: Exception) -> None:
        """Reports that the server refuses writes. A missing answer is not a refusal."""
        if isinstance(error, (APIError, ServerError)):
            self._refusal = error
            self.set_reason(nats_reason(error))

    def _note_write(self) -> None:
        """Notes that a write of this or another node was accepted."""
        if self._refusal is not None:
            self._refusal = None
            self.set_reason(None)

    def _saw(self, key: str, entry: Entry) -> None:
        self._heard = time.monotonic()
        before = self.seen.get(key)
        if before is not None and entry.revision <= before.revision:
            return
        self.seen[key] = entry
        # Only this node may lack a permission. What it need not write is no reason.
        is_over = not isinstance(self._refusal, ServerError) or self._stands_by()
        if is_over and (entry.holding is not None or key == SETTLED):
            self._note_write()
        was, now = (None if each is None else each.holding for each in (before, entry))
        same = was is not None and now is not None and was.process == now.process
        if not same:
            self._news.set()
            self._watcher.changed()

    def _stands_by(self) -> bool:
        """Whether other nodes hold all leases that are wanted."""
        holders = map(self.holder, self._wanted)
        return all(each is not None and each.process != self.process for each in holders)

    def _take_free(self, now: float) -> None:
        if self._bucket is None or not self._is_followed or not self.is_read:
            return
        if SETTLED not in self.seen:
            if now >= self.may_settle_at and not self._is_settling:
                self._is_settling = True
                self._begin(self._settle(self._bucket))
            return
        for key in self._wanted:
            if key in self._held or key in self._taking or key in self._returning_keys:
                continue
            entry = self.seen.get(key)
            if entry is None or not entry.is_live(now, self.times) or self._is_own(entry):
                self._taking.add(key)
                self._begin(self._take(self._bucket, key, entry))

    def _is_own(self, entry: Entry) -> bool:
        """Whether nobody has taken a lease since this process had it, or tried to take it."""
        return entry.holding is not None and entry.holding.process == self.process

    async def _settle(self, bucket: LeaseBucket) -> None:
        """Says that no lease of a former bucket can be in use any more."""
        made_at = self._made_at
        try:
            entry = await bucket.settle()
        except Outdated:
            return  # Another node was first, and this one is about to hear of it.
        except (Error, OSError) as error:
            self._note_failure(error)
            return
        finally:
            self._is_settling = False
        self._note_write()
        if made_at == self._made_at:
            self.seen.setdefault(SETTLED, entry)
        self._news.set()

    async def _take(self, bucket: LeaseBucket, key: str, entry: Entry | None) -> None:
        try:
            await self._begin_to_hold(bucket, key, entry)
        finally:
            self._taking.discard(key)

    async def _begin_to_hold(self, bucket: LeaseBucket, key: str, entry: Entry | None) -> None:
        holding = Holding(
            node=self.node,
            process=self.process,
            taken=int(time.time() * 1000),
            about=self._about(key),
        )
        sent, made_at = time.monotonic(), self._made_at
        try:
            revision = await bucket.put(
                key, msgspec.json.encode(holding), 0 if entry is None else entry.revision
            )
        except Outdated:
            await self._read(bucket, key)
            return
        except NoStreamResponseError:
            self._is_followed = False  # It is made again.
            return
        except (Error, OSError) as error:
            self._note_failure(error)
            # If it was taken all the same, it is taken again.
            await self._read(bucket, key)
            return
        self._acknowledged = time.monotonic()
        self._note_write()
        if made_at != self._made_at:
            return
        self.seen[key] = Entry(revision, holding, sent)
        clean = entry is not None and entry.is_given_back
        if key not in self._wanted:
            with contextlib.suppress(Outdated, Error, OSError):
                await bucket.delete(key, revision, is_clean=clean)
            return
        until = sent + self.times.hold_s
        self._held[key] = _Held(revision, holding, revision, until)
        # Revisions begin anew with another bucket.
        epoch = 0 if made_at is None else int(made_at.timestamp())
        settle = 0.0 if clean else self.times.settle_s
        self.fence(key).open(until, term=(max(epoch, 0), revision), settle=settle)
        self._watcher.taken(key)

    async def _read(self, bucket: LeaseBucket, key: str) -> None:
        """Reads a key that is not as it was last seen."""
        with contextlib.suppress(Error, OSError):
            entry = await bucket.get(key)
            if entry is None:
                self.seen.pop(key, None)
            else:
                self._saw(key, entry)

    async def _renew(self, key: str, held: _Held) -> None:
        if held.lock.locked():
            return
        async with held.lock:
            if self._held.get(key) is not held:
                return
            held.is_late = True
            try:
                await self._put_again(key, held)
            except Outdated:
                pass
            except NoAnswer:
                self._news.set()  # Waiting for it has used up most of the time.
            except (Error, OSError) as error:
                self._note_failure(error)

    async def _put_again(self, key: str, held: _Held) -> None:
        """Renews a lease. Raises as `LeaseBucket.put` does."""
        bucket = self._bucket
        if bucket is None or self._client is None:
            return
        try:
            await self._put(bucket, key, held)
        except Outdated:
            if await self._is_still_own(bucket, key, held):
                await self._put(bucket, key, held)

    async def _put(self, bucket: LeaseBucket, key: str, held: _Held) -> None:
        held.holding = msgspec.structs.replace(held.holding, about=self._about(key))
        value = msgspec.json.encode(held.holding)
        sent = time.monotonic()
        held.revision = await bucket.put(key, value, held.revision)
        self._acknowledged = time.monotonic()
        self._note_write()
        held.is_late = False
        held.until = sent + self.times.hold_s
        self._fences[key].renew(held.until)

    async def _is_still_own(self, bucket: LeaseBucket, key: str, held: _Held) -> bool:
        """Finds out who has written a key: another holder, or an own renewal without an answer.

        Takes over the revision of an own one; gives the lease up otherwise. Raises the errors of
        nats-py.
        """
        entry = await bucket.get(key)
        if entry is not None and self._is_own(entry):
            held.revision = entry.revision
            return True
        if entry is not None:
            self._saw(key, entry)
        ended = entry is None or entry.holding is None
        self._give_up(key, "it has ended" if ended else "another node holds it")
        return False

    def _note_lapsed(self, now: float, reason: str) -> None:
        """Gives up leases that could not be renewed for so long that others may have taken them."""
        for key, held in self._held.copy().items():
            lapsed_at = held.until - self.times.hold_s + self.times.ttl_s
            if now >= lapsed_at and not held.lock.locked():
                self._give_up(key, reason)

    def _give_up(self, key: str, reason: str) -> None:
        self._fences[key].close()
        if self._held.pop(key, None) is not None:
            self._watcher.lost(key, reason)

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        tasks.begin(work, self._tasks)
