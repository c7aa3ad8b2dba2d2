"""Leases in a bucket of a real NATS server: one holder at a time, whatever happens to it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any

import pytest
from nats.aio.client import Client, ServerVersion
from nats.errors import TimeoutError as NatsTimeout

from holdfast.net.nats import tolerant_client
from holdfast.net.nats.connection import NatsConnection, Ping, Servers
from holdfast.net.nats.key_bucket import Outdated
from holdfast.replication.leases.bucket import SETTLED, LeaseBucket
from holdfast.replication.leases.leases import Leases
from holdfast.replication.leases.times import LeaseTimes
from support import wire
from support.brokers import NatsServer
from support.leases import ENDLESS, LASTING, SHORT, make_settled

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from pathlib import Path

BUCKET = "leases"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    server = NatsServer(tmp_path)
    yield server
    server.kill()


@pytest.fixture
def settled(server: NatsServer) -> NatsServer:
    """A server with a bucket in which leases may be taken."""
    make_settled(server.url, BUCKET)
    return server


class Node:
    """One holder of leases, with a connection of its own."""

    def __init__(self, name: str, times: LeaseTimes) -> None:
        self.leases = Leases(BUCKET, name, self, times=times)
        self.events: list[str] = []
        self.client: Client | None = None
        self.watch: Callable[[], None] = lambda: None
        """Called when a lease was taken."""

    def taken(self, key: str) -> None:
        self.watch()
        self.events.append(f"taken {key}")

    def lost(self, key: str, reason: str) -> None:
        self.events.append(f"lost {key}: {reason}")

    def changed(self) -> None:
        pass

    def availability_changed(self, reason: str | None) -> None:
        self.events.append("works" if reason is None else f"fails: {reason}")

    def connected(self, client: Client | None) -> None:
        self.client = client
        self.leases.connected(client)


@contextlib.asynccontextmanager
async def running(url: str, name: str, times: LeaseTimes) -> AsyncIterator[Node]:
    """A node that disappears at the end of the block, without giving anything back."""
    node = Node(name, times)
    broker = NatsConnection(Servers((url,)), {}, node.connected, Ping(), name="test")
    tasks = [asyncio.create_task(broker.run()), asyncio.create_task(node.leases.run())]
    try:
        yield node
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def until(condition: Callable[[], Any], what: str) -> None:
    end = time.monotonic() + wire.DEADLINE
    while not condition():
        assert time.monotonic() < end, f"not within {wire.DEADLINE} s: {what}"
        await asyncio.sleep(0.01)


def test_a_holder_stops_before_others_may_begin_and_renews_before_that() -> None:
    with pytest.raises(AssertionError):
        LeaseTimes(ttl_s=2.0, hold_s=2.0)
    with pytest.raises(AssertionError):
        LeaseTimes(hold_s=1.0, renewal_s=1.0)


@pytest.mark.parametrize(("ttl_s", "of_server"), [(0.6, 1), (1.0, 1), (1.5, 2), (3.0, 3)])
def test_a_server_deletes_no_key_before_its_lease_has_ended(ttl_s: float, of_server: int) -> None:
    assert LeaseTimes(ttl_s, hold_s=0.4, renewal_s=0.2).server_ttl_s == of_server


def test_the_holder_keeps_its_lease_and_another_takes_it_when_it_is_gone(
    settled: NatsServer,
) -> None:
    async def work() -> None:
        async with running(settled.url, "b", LASTING) as second:
            async with running(settled.url, "a", LASTING) as first:
                first.leases.want(["x"])
                await until(lambda: first.leases.is_held("x"), "the first node has it")
                second.leases.want(["x"])
                since = first.leases.held["x"]
                await until(lambda: second.leases.holder("x") is not None, "the second one knows")
                holder = second.leases.holder("x")
                assert holder is not None
                assert holder.node == "a"
                # Several renewals later, nothing has changed.
                revision = second.leases.seen["x"].revision
                await until(lambda: second.leases.seen["x"].revision >= revision + 4, "renewals")
                assert dict(first.leases.held) == {"x": since}
                assert not second.leases.held
                fence = first.leases.fence("x")
                assert fence.is_open
            assert not fence.allows
            await until(lambda: second.leases.is_held("x"), "the second node has taken over")
            assert second.leases.held["x"] > since

    asyncio.run(work())


def test_a_lease_that_is_given_back_is_taken_at_once(settled: NatsServer) -> None:
    async def work() -> None:
        async with (
            running(settled.url, "a", ENDLESS) as first,
            running(settled.url, "b", ENDLESS) as second,
        ):
            first.leases.want(["x"])
            await until(lambda: first.leases.is_held("x"), "the first node has it")
            second.leases.want(["x"])
            await until(lambda: second.leases.holder("x") is not None, "the second one knows")
            first.leases.want([])
            assert await first.leases.give_back("x", 1.0)
            assert not first.leases.fence("x").allows
            await until(lambda: second.leases.is_held("x"), "the second node has it")

    asyncio.run(work())


def test_a_renewal_that_was_not_confirmed_is_found(
    settled: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = LeaseBucket.put
    lost = 0

    async def put(bucket: LeaseBucket, key: str, value: bytes, revision: int) -> int:
        nonlocal lost
        done = await original(bucket, key, value, revision)
        if revision and not lost:
            lost += 1
            raise NatsTimeout
        return done

    async def work() -> None:
        async with running(settled.url, "a", LASTING) as node:
            node.leases.want(["x"])
            await until(lambda: lost, "a confirmation is lost")
            revision = node.leases.seen["x"].revision
            await until(lambda: node.leases.seen["x"].revision > revision + 2, "renewals go on")
            assert not [event for event in node.events if event.startswith("lost")]

    monkeypatch.setattr(LeaseBucket, "put", put)
    asyncio.run(work())


def test_without_the_server_a_holder_stops_before_others_may_begin(settled: NatsServer) -> None:
    async def work() -> None:
        async with running(settled.url, "a", SHORT) as node:
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it is held")
            fence = node.leases.fence("x")
            settled.kill()
            await until(lambda: not fence.allows, "the fence has closed")
            await until(lambda: "x" not in node.leases.held, "the lease is given up")
            assert node.events[-1] == "lost x: it could not be renewed"
            settled.start()
            await until(lambda: node.leases.is_held("x"), "it is held again")
            assert fence.is_open

    asyncio.run(work())


def test_a_former_holder_changes_nothing(settled: NatsServer) -> None:
    async def work() -> None:
        async with (
            running(settled.url, "a", LASTING) as first,
            running(settled.url, "b", LASTING) as second,
        ):
            first.leases.want(["x"])
            await until(lambda: first.leases.is_held("x"), "the first node has it")
            revision = first.leases.seen["x"].revision
            second.leases.want(["x"])
            await until(lambda: second.leases.holder("x") is not None, "the second one knows")
            # The first one is stopped for longer than the lease lasts.
            held = first.leases.connected
            held(None)
            await until(lambda: second.leases.is_held("x"), "the second node has taken over")
            assert not first.leases.fence("x").allows
            assert first.client is not None
            bucket = LeaseBucket(first.client, BUCKET)
            with pytest.raises(Outdated):
                await bucket.put("x", b"{}", revision)
            with pytest.raises(Outdated):
                await bucket.delete("x", revision)
            held(first.client)
            await until(
                lambda: (holder := first.leases.holder("x")) and holder.node == "b",
                "it knows the new holder",
            )
            assert not first.leases.held
            assert second.leases.is_held("x")

    asyncio.run(work())


def test_a_node_that_may_not_write_the_bucket_says_so(tmp_path: Path) -> None:
    file, deny = tmp_path / "nats.conf", f"{{publish: {{deny: '$KV.{BUCKET}.>'}}}}"
    user = f"{{user: a, password: a, permissions: {deny}}}"
    users = f"[{user}, {{user: b, password: b}}]"
    file.write_text(f"no_auth_user: a, authorization: {{users: {users}}}")
    server = NatsServer(tmp_path, "-c", str(file))
    allowed = server.url.replace("//", "//b:b@")
    reason = f'Permissions Violation for Publish to "$KV.{BUCKET}.x"'

    async def work() -> None:
        async with running(server.url, "a", LASTING) as node:
            node.leases.want(["x"])
            await until(lambda: len(node.events) == 2, "it is refused")
            node.leases.want([])
            node.connected(node.client)
            await until(lambda: len(node.events) == 3, "it may be allowed with a new connection")
            node.leases.want(["x"])
            await until(lambda: len(node.events) == 4, "it is refused again")
            # What others may write does not help it.
            async with running(allowed, "b", LASTING) as other:
                other.leases.want(["y"])
                await until(lambda: node.leases.holder("y") is not None, "it sees another lease")
                assert node.leases.reason == reason
                # It need not write as long as others hold all that it wants.
                other.leases.want(["x", "y"])
                await until(lambda: node.leases.reason is None, "it stands by")
            assert node.events == [*2 * ["works", f"fails: {reason}"], "works"]

    try:
        make_settled(allowed, BUCKET)
        asyncio.run(work())
    finally:
        server.kill()


def test_a_node_whose_inboxes_were_forbidden_takes_its_lease_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_REPEAT_S", "MAX_REPEAT_S"):
        monkeypatch.setattr(tolerant_client, name, 0.05)
    file = tmp_path / "nats.conf"

    def write(denied: str) -> None:
        user = f"{{user: a, password: a, permissions: {{subscribe: {{deny: '{denied}'}}}}}}"
        file.write_text(f"no_auth_user: a, authorization: {{users: [{user}]}}")

    write("nothing")
    server = NatsServer(tmp_path, "-c", str(file))

    async def work() -> None:
        async with running(server.url, "a", LASTING) as node:
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it has it")
            client = node.client
            write("_INBOX.>")
            server.reload()
            await until(lambda: "x" not in node.leases.held, "no answer reaches it")
            write("nothing")
            server.reload()
            await until(lambda: node.leases.is_held("x"), "it has it again")
            assert node.client is client

    try:
        make_settled(server.url, BUCKET)
        asyncio.run(work())
    finally:
        server.kill()


def test_an_old_server_is_named(server: NatsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    old = property(lambda _: ServerVersion("2.10.29"))
    monkeypatch.setattr(tolerant_client.SafeClient, "connected_server_version", old)

    async def work() -> None:
        # An old server ignores that keys should have TTLs.
        client = Client()
        await client.connect(server.url)
        name = f"KV_{BUCKET}"
        await client.jetstream().add_stream(name=name, subjects=[f"$KV.{BUCKET}.>"])
        await client.close()
        async with running(server.url, "a", SHORT) as node:
            await until(lambda: "2.11 or newer" in str(node.leases.reason), "it says so")
            assert str(node.leases.reason).endswith("and this is 2.10.29")

    asyncio.run(work())


def test_a_bucket_of_another_kind_is_named(server: NatsServer) -> None:
    async def work() -> None:
        async with running(server.url, "b", SHORT) as node:
            await until(lambda: node.leases.reason is None, "the bucket is made")
            assert node.client is not None
            await node.client.jetstream().delete_stream(f"KV_{BUCKET}")
            await node.client.jetstream().add_stream(
                name=f"KV_{BUCKET}", subjects=[f"$KV.{BUCKET}.>"]
            )
        async with running(server.url, "a", SHORT) as node:
            node.leases.want(["x"])
            await until(lambda: "exists without TTLs" in str(node.leases.reason), "it says so")
            assert not node.leases.held
            assert str(node.leases.reason).endswith(": delete it, so that it is made again")
            # As of a log whose name ended like the buckets of this one.
            assert node.client is not None
            await node.client.jetstream().publish(f"$KV.{BUCKET}.snapshot", b"{}")
            await until(lambda: "has 1 key, such as 'snapshot'" in str(node.leases.reason), "which")
            assert str(node.leases.reason).endswith("so delete it only if nothing does")

    asyncio.run(work())


def test_a_bucket_that_was_deleted_is_made_again(settled: NatsServer) -> None:
    async def work() -> None:
        async with running(settled.url, "a", SHORT) as node:
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it is held")
            assert node.client is not None
            await node.client.jetstream().delete_stream(f"KV_{BUCKET}")
            await until(lambda: "x" not in node.leases.held, "it is given up")
            await until(lambda: node.leases.is_held("x"), "it is held again")

    asyncio.run(work())


def test_nodes_agree_again_after_the_server_has_lost_its_storage(settled: NatsServer) -> None:
    async def work() -> None:
        async with (
            running(settled.url, "a", LASTING) as first,
            running(settled.url, "b", LASTING) as second,
        ):
            for node in (first, second):
                node.leases.want(["x"])
            nodes = [first, second]
            await until(lambda: any(node.leases.held for node in nodes), "one has it")
            before = max(node.leases.since("x") for node in nodes)
            settled.kill()
            settled.lose_store()
            settled.start()
            await until(lambda: not any(node.leases.held for node in nodes), "it was lost")
            await until(lambda: any(node.leases.held for node in nodes), "one has it again")
            [holder] = [node for node in nodes if node.leases.held]
            [other] = [node for node in nodes if not node.leases.held]
            await until(
                lambda: (found := other.leases.holder("x")) and found.node == holder.leases.node,
                "the other one knows",
            )
            # Consumers drop values with an earlier revision.
            assert holder.leases.since("x") > before
            holder.leases.want([])
            assert await holder.leases.give_back("x", 1.0)
            await until(lambda: other.leases.is_held("x"), "the other one takes over")

    asyncio.run(work())


def test_a_bucket_that_replaces_another_one_waits_for_leases_of_that_one(
    server: NatsServer,
) -> None:
    async def work() -> None:
        async with running(server.url, "a", SHORT) as first:
            first.leases.want(["x"])
            await until(lambda: first.leases.is_held("x"), "it is held")
            assert first.client is not None
            await first.client.jetstream().delete_stream(f"KV_{BUCKET}")
            first.leases.want([])
            async with running(server.url, "b", SHORT) as second:
                were_open = []
                second.watch = lambda: were_open.append(first.leases.fence("x").allows)
                second.leases.want(["x"])
                await until(lambda: second.leases.is_held("x"), "the other node has it")
            assert were_open == [False]

    asyncio.run(work())


def test_a_lease_is_held_though_the_answer_was_lost(
    settled: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = LeaseBucket.put
    lost = 0

    async def put(on: LeaseBucket, key: str, value: bytes, revision: int) -> int:
        nonlocal lost
        done = await original(on, key, value, revision)
        if not lost:
            lost += 1
            raise NatsTimeout
        return done

    async def work() -> None:
        async with running(settled.url, "a", ENDLESS) as node:
            await until(lambda: SETTLED in node.leases.seen, "leases may be taken")
            node.leases.want(["x"])
            await until(lambda: lost, "an answer is lost")
            await until(lambda: node.leases.is_held("x"), "it is held")

    monkeypatch.setattr(LeaseBucket, "put", put)
    asyncio.run(work())


def test_a_bucket_that_does_not_open_delays_no_renewal(
    settled: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def never(*_: object) -> None:
        await asyncio.Event().wait()

    async def work() -> None:
        async with running(settled.url, "a", LASTING) as node:
            node.leases.want(["x"])
            await until(lambda: node.leases.is_held("x"), "it is held")
            monkeypatch.setattr(LeaseBucket, "open", never)
            node.leases.connected(None)
            node.leases.connected(node.client)
            revisions = {node.leases.revision("x")}

            def is_renewed() -> bool:
                revisions.add(node.leases.revision("x"))
                return len(revisions) > 4

            await until(is_renewed, "it is renewed")
            assert not [event for event in node.events if event.startswith("lost")]

    asyncio.run(work())
