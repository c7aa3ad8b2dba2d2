"""One holder of leases, with a bucket that loses answers, refuses writes, and can't be followed."""

from __future__ import annotations

import asyncio
import contextlib
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from nats.errors import TimeoutError as NatsTimeout
from nats.js.errors import ServiceUnavailableError

from holdfast.net.nats.key_bucket import Outdated
from holdfast.replication.leases import leases as module
from holdfast.replication.leases.bucket import (
    SETTLED,
    Entry,
    Holding,
    LeaseBucket,
    entry,
)
from holdfast.replication.leases.leases import Leases
from holdfast.replication.leases.times import LeaseTimes
from support import wire

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

STILL = LeaseTimes(ttl_s=3600.0, hold_s=1800.0, renewal_s=1000.0)
"""For leases that are not renewed while a test runs, except for another reason than the time."""


class MemoryBucket:
    """A bucket in this process."""

    def __init__(self, *, settled: bool = True) -> None:
        self.client = object()
        self.entries = {SETTLED: Entry(1, None, 0.0)} if settled else {}
        self.lost_answers = 0
        self.refusals = 0
        self.is_full = False
        self.stored = asyncio.Event()
        self.may_answer = asyncio.Event()
        self.may_answer.set()
        self.deleted: list[tuple[str, bool]] = []

    async def open(self, *_: int) -> tuple[None, int]:
        return None, 1

    async def unfollow(self) -> None:
        pass

    async def follow(self, take: Callable[[str, Entry], None], read: Callable[[], None]) -> None:
        for key, found in self.entries.items():
            take(key, found)
        read()

    async def settle(self) -> Entry:
        self._refuse()
        return Entry(1, None, time.monotonic())

    async def put(self, key: str, value: bytes, revision: int) -> int:
        self._refuse()
        if revision != self.revision(key):
            raise Outdated(key)
        self.entries[key] = entry(revision + 1, None, value, time.monotonic())
        self.stored.set()
        await self.may_answer.wait()
        if self.lost_answers:
            self.lost_answers -= 1
            raise NatsTimeout
        return revision + 1

    async def get(self, key: str) -> Entry | None:
        return self.entries.get(key)

    async def delete(self, key: str, revision: int, *, is_clean: bool = True) -> None:
        assert revision == self.revision(key)
        self.deleted.append((key, is_clean))

    def revision(self, key: str) -> int:
        return self.entries[key].revision if key in self.entries else 0

    def _refuse(self) -> None:
        if self.is_full:
            self.refusals += 1
            raise ServiceUnavailableError(code=503, description="insufficient storage")


class Node:
    """Leases, and what they report."""

    def __init__(self) -> None:
        self.leases = Leases("leases", "a", self, times=STILL)
        self.events: list[str] = []

    def taken(self, key: str) -> None:
        self.events.append(f"taken {key}")

    def lost(self, key: str, reason: str) -> None:
        self.events.append(f"lost {key}: {reason}")

    def changed(self) -> None:
        pass

    def availability_changed(self, reason: str | None) -> None:
        shown = "works" if reason is None else "is full"
        assert reason is None or "insufficient storage" in reason
        self.events.append(shown)


@contextlib.asynccontextmanager
async def running(bucket: Any, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Node]:
    node = Node()
    monkeypatch.setattr(module, "LeaseBucket", lambda *_: bucket)
    node.leases.connected(bucket.client)
    task = asyncio.create_task(node.leases.run())
    try:
        yield node
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(condition: Callable[[], Any], what: str) -> None:
    end = time.monotonic() + wire.DEADLINE
    while not condition():
        assert time.monotonic() < end, f"not within {wire.DEADLINE} s: {what}"
        await asyncio.sleep(0.001)


def test_a_renewal_after_one_without_an_answer_is_confirmed_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        bucket = MemoryBucket()
        async with running(bucket, monkeypatch) as node:
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it is held")
            bucket.lost_answers = 1
            await node.leases.renew_now("x")
            assert node.leases.revision("x") == 1
            # The bucket never waits, so nothing else runs meanwhile.
            await node.leases.renew_now("x")
            assert node.leases.revision("x") == bucket.revision("x") == 3

    asyncio.run(work())


def test_a_renewal_without_an_answer_is_repeated_before_the_next_one_is_due(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        bucket = MemoryBucket()
        # Only the lost answer wakes it.
        monkeypatch.setattr(module, "TICK_S", wire.DEADLINE * 10)
        async with running(bucket, monkeypatch) as node:
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it is held")
            bucket.lost_answers = 1
            await node.leases.renew_now("x")
            await until(lambda: node.leases.revision("x") == 3, "it is renewed")

    asyncio.run(work())


def test_refused_renewals_are_reported_and_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work() -> None:
        bucket = MemoryBucket()
        async with running(bucket, monkeypatch) as node:
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it is held")
            bucket.is_full = True
            await node.leases.renew_now("x")
            await until(lambda: bucket.refusals > 2, "it is repeated")
            bucket.is_full = False
            await until(lambda: node.leases.revision("x") == 2, "it is renewed")
            assert node.events == ["works", "taken x", "is full", "works"]

    asyncio.run(work())


def test_a_lease_that_is_refused_is_reported_and_taken_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        bucket = MemoryBucket()
        bucket.is_full = True
        async with running(bucket, monkeypatch) as node:
            node.leases.want(["x"])
            await until(lambda: bucket.refusals > 2, "it is refused")
            # The bucket opens all the same, which does not show that it accepts writes.
            node.leases.connected(None)
            node.leases.connected(bucket.client)  # type: ignore[arg-type]
            refusals = bucket.refusals
            await until(lambda: bucket.refusals > refusals + 2, "it is refused again")
            bucket.is_full = False
            await until(lambda: node.leases.is_held("x"), "it is held")
            assert node.events == ["works", "is full", "works", "taken x"]

    asyncio.run(work())


def test_a_write_of_another_node_shows_that_writes_are_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        bucket = MemoryBucket()
        bucket.is_full = True
        async with running(bucket, monkeypatch) as node:
            node.leases.want(["x"])
            await until(lambda: bucket.refusals, "it is refused")
            bucket.entries["x"] = Entry(1, Holding(node="b", process="b"), time.monotonic())
            node.leases.connected(None)
            node.leases.connected(bucket.client)  # type: ignore[arg-type]
            await until(lambda: node.leases.reason is None, "it works")
            assert node.events == ["works", "is full", "works"]

    asyncio.run(work())


def test_a_bucket_that_can_not_be_settled_is_reported_and_not_asked_all_the_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        bucket = MemoryBucket(settled=False)
        bucket.is_full = True
        monkeypatch.setattr(module, "TICK_S", wire.DEADLINE * 10)
        async with running(bucket, monkeypatch) as node:
            await until(lambda: bucket.refusals, "it is refused")
            for _ in range(20):
                await asyncio.sleep(0)
            assert bucket.refusals == 1
            assert node.events == ["works", "is full"]
            bucket.is_full = False
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it is held")
            assert node.events == ["works", "is full", "works", "taken x"]

    asyncio.run(work())


@pytest.mark.parametrize("was_given_back", [False, True])
def test_a_lease_that_is_not_wanted_any_more_when_it_is_taken_is_given_back(
    monkeypatch: pytest.MonkeyPatch, *, was_given_back: bool
) -> None:
    async def work() -> None:
        bucket = MemoryBucket()
        if was_given_back:
            bucket.entries["x"] = Entry(1, None, 0.0, is_given_back=True)
        bucket.may_answer.clear()
        async with running(bucket, monkeypatch) as node:
            node.leases.want(["x"])
            await asyncio.wait_for(bucket.stored.wait(), wire.DEADLINE)
            node.leases.want([])
            assert await node.leases.give_back("x", 0.0)
            bucket.may_answer.set()
            await until(lambda: bucket.deleted, "it is deleted")
            # What an earlier holder has sent may still arrive.
            assert bucket.deleted == [("x", was_given_back)]
            assert not node.leases.held
            assert not node.leases.fence("x").allows
            assert node.events == ["works"]

    asyncio.run(work())


class Followed:
    """A client that counts its subscriptions. `answer` is called before one is confirmed."""

    def __init__(self, answer: Callable[[], None]) -> None:
        self.begun = self.ended = 0
        self._answer = answer

    def jetstream(self, timeout: float) -> Followed:  # noqa: ARG002
        return self

    async def stream_info(self, _: str) -> Any:
        config = SimpleNamespace(allow_msg_ttl=True, max_msgs_per_subject=1)
        return SimpleNamespace(config=config, state=SimpleNamespace(last_seq=0), created=None)

    async def subscribe(self, *_: Any, **__: Any) -> Followed:
        self.begun += 1
        return self

    async def consumer_info(self) -> Any:
        self._answer()
        return SimpleNamespace(num_pending=0, delivered=None)

    async def unsubscribe(self) -> None:
        self.ended += 1


def test_a_bucket_that_can_not_be_followed_leaves_no_subscription() -> None:
    def answer() -> None:
        raise NatsTimeout

    async def work() -> None:
        client: Any = Followed(answer)
        bucket = LeaseBucket(client, "leases")
        with pytest.raises(NatsTimeout):
            await bucket.follow(lambda *_: None, lambda: None)
        assert (client.begun, client.ended) == (1, 1)

    asyncio.run(work())


def test_a_bucket_of_a_former_connection_leaves_no_subscription() -> None:
    async def work() -> None:
        node = Node()
        client: Any = Followed(lambda: node.leases.connected(None))
        node.leases.connected(client)
        task = asyncio.create_task(node.leases.run())
        await until(lambda: client.begun, "it is followed")
        await until(lambda: client.ended, "it is not followed any more")
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert (client.begun, client.ended) == (1, 1)

    asyncio.run(work())
