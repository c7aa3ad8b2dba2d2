"""The thread that holds leases: it renews them whatever the rest of the process does."""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.net.nats.connection import NatsConnection, Ping, Servers
from holdfast.replication.leases.bucket import LeaseBucket
from holdfast.replication.leases.leases import Leases
from holdfast.replication.leases.thread import LeaseThread, Relay
from holdfast.replication.leases.times import LeaseTimes
from holdfast.runtime import tasks
from support import wire
from support.brokers import NatsServer
from support.leases import ENDLESS, LASTING, make_settled
from support.nats_bus import logged

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from nats.aio.client import Client

BUCKET = "leases"
LIMIT = 1.0


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    server = NatsServer(tmp_path)
    make_settled(server.url, BUCKET)
    yield server
    server.kill()


class Node:
    """Leases in a thread."""

    def __init__(self, server: NatsServer, name: str, times: LeaseTimes = LASTING) -> None:
        self.events: list[str] = []
        self.withheld: str | None = None
        self.asked = 0
        self.leases = Leases(BUCKET, name, self, times=times, withheld=self._why_withheld)
        self.thread = LeaseThread(self.leases, self._connect, f"leases of {name}", retry_s=0.01)
        self._servers = Servers((server.url,))

    def _why_withheld(self) -> str | None:
        self.asked += 1
        return self.withheld

    def looks_several_times(self) -> None:
        asked = self.asked
        wire.until(lambda: self.asked >= asked + 5, "the leases are looked at")

    async def _connect(self, connected: Callable[[Client | None], None]) -> None:
        await NatsConnection(self._servers, {}, connected, Ping(), name="test").run()

    def taken(self, key: str) -> None:
        self.events.append(f"taken {key}")

    def lost(self, key: str, reason: str) -> None:
        self.events.append(f"lost {key}: {reason}")

    def changed(self) -> None:
        pass

    def availability_changed(self, reason: str | None) -> None:
        pass

    def has(self, *keys: str) -> None:
        wire.until(lambda: all(map(self.leases.is_held, keys)), "they are held")

    def renews(self, key: str) -> None:
        """Waits for longer than a lease lasts without renewals."""
        revision, end = self.leases.revision(key), time.monotonic() + self.leases.times.ttl_s
        wire.until(lambda: time.monotonic() > end, "it would have ended")
        wire.until(lambda: self.leases.revision(key) > revision + 4, "it is renewed")


@pytest.fixture
def node(server: NatsServer) -> Iterator[Callable[..., Node]]:
    with ExitStack() as running:

        def start(name: str, times: LeaseTimes = LASTING) -> Node:
            node = Node(server, name, times)
            node.thread.start()
            running.callback(node.thread.stop, LIMIT)
            return node

        yield start


def threads() -> list[str]:
    return [each.name for each in threading.enumerate() if each.name.startswith("leases of")]


class LosesCancellation(Node):
    """Goes on connecting after its cancellation, as nats-py may do with Python 3.11."""

    connecting = False

    async def _connect(self, _: Callable[[Client | None], None]) -> None:
        self.connecting = True
        with suppress(asyncio.CancelledError):
            await asyncio.Event().wait()
        await asyncio.Event().wait()


def test_a_thread_ends_while_it_connects(
    server: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "CANCEL_INTERVAL_S", 0.01)
    node = LosesCancellation(server, "a")
    node.thread.start()
    wire.until(lambda: node.connecting, "it connects")
    stopping = threading.Thread(target=node.thread.stop, args=(LIMIT,), daemon=True)
    stopping.start()
    stopping.join(wire.DEADLINE)
    assert not stopping.is_alive()


def test_leases_are_renewed_while_the_event_loop_of_their_user_does_something_else(
    node: Callable[..., Node],
) -> None:
    first, second = node("a"), node("b")

    async def work() -> None:
        first.thread.want(["x"])
        first.has("x")  # Blocks this loop, as everything below.
        second.thread.want(["x"])
        since = first.leases.since("x")
        first.renews("x")
        assert first.leases.since("x") == since
        assert first.leases.fence("x").is_open
        assert not second.leases.held

    asyncio.run(work())
    assert first.events == ["taken x"]


def test_the_end_of_the_thread_gives_everything_back(node: Callable[..., Node]) -> None:
    first, second = node("a", ENDLESS), node("b", ENDLESS)
    first.thread.want(["x", "y"])
    first.has("x", "y")
    second.thread.want(["x", "y"])
    first.thread.stop(LIMIT)
    assert threads() == ["leases of b"]
    assert not first.leases.fence("x").allows
    second.has("x", "y")


def test_the_end_of_the_thread_gives_back_what_is_being_taken(
    node: Callable[..., Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = threading.Event()
    order: list[str] = []
    original_put, original_delete, original_end = LeaseBucket.put, LeaseBucket.delete, tasks.end

    async def put(bucket: LeaseBucket, *arguments: Any) -> int:
        done = await original_put(bucket, *arguments)
        stored.set()
        while first.leases._wanted:
            await asyncio.sleep(0.001)
        return done

    async def delete(bucket: LeaseBucket, *arguments: Any, **more: Any) -> None:
        await original_delete(bucket, *arguments, **more)
        order.append("given back")

    async def end(running: Any) -> None:
        if not first.leases._wanted:
            order.append("end")
        await original_end(running)

    first, second = node("a", ENDLESS), node("b", ENDLESS)
    with monkeypatch.context() as patched:
        patched.setattr(LeaseBucket, "put", put)
        patched.setattr(LeaseBucket, "delete", delete)
        first.thread.want(["x"])
        assert stored.wait(wire.DEADLINE)
        patched.setattr(tasks, "end", end)
        first.thread.stop(LIMIT)
    assert order[:2] == ["given back", "end"]
    second.thread.want(["x"])
    second.has("x")


def test_what_is_asked_of_a_thread_that_has_ended_has_no_effect(
    node: Callable[..., Node],
) -> None:
    ended = node("a")
    wire.until(lambda: ended.leases.reason is None, "it is connected")
    ended.thread.stop(LIMIT)

    async def work() -> None:
        ended.thread.want(["x"])
        ended.thread.give_back_soon("x", LIMIT)
        await ended.thread.give_back("x", LIMIT)
        await ended.thread.renew_now("x")

    asyncio.run(work())
    assert not ended.leases.held


def test_an_error_in_the_thread_closes_all_fences_and_the_leases_are_taken_again(
    node: Callable[..., Node], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fails = threading.Event()
    original = Leases._take_free

    def take_free(leases: Leases, now: float) -> None:
        if fails.is_set():
            raise RuntimeError("a mistake")
        original(leases, now)

    monkeypatch.setattr(Leases, "_take_free", take_free)
    one = node("a")
    one.thread.want(["x"])
    one.has("x")
    fails.set()
    wire.until(lambda: "lost x: an internal error" in one.events, "it is given up")
    assert not one.leases.fence("x").allows
    assert not one.leases.held
    fails.clear()
    one.has("x")
    assert logged(caplog, "leases_failed")[0] == {"bucket": BUCKET}


def test_a_node_that_can_not_use_its_devices_lets_others_have_them(
    node: Callable[..., Node],
) -> None:
    first, second = node("a"), node("b")
    first.thread.want(["x"])
    first.has("x")
    second.thread.want(["x"])
    first.withheld = "there is nobody to tell"
    second.has("x")
    assert not first.leases.fence("x").allows
    wire.until(lambda: first.events[1:] == ["lost x: there is nobody to tell"], "it is told")
    first.withheld = None
    second.thread.want([])
    second.thread.give_back_soon("x", LIMIT)
    first.has("x")


def test_a_lease_that_is_withheld_when_it_is_due_is_renewed_as_soon_as_it_is_not(
    node: Callable[..., Node],
) -> None:
    one = node("a", LeaseTimes(ttl_s=300.0, hold_s=200.0, renewal_s=0.1))
    one.thread.want(["x"])
    one.has("x")
    one.withheld = "there is nobody to tell"
    one.looks_several_times()
    one.leases.times = LeaseTimes(ttl_s=300.0, hold_s=200.0, renewal_s=100.0)
    one.looks_several_times()  # It becomes due.
    revision = one.leases.revision("x")
    one.withheld = None
    wire.until(lambda: one.leases.revision("x") > revision, "it is renewed")


def test_another_event_loop_is_told_in_order_and_of_many_changes_once() -> None:
    class Watcher:
        def __init__(self) -> None:
            self.events: list[str] = []

        def taken(self, key: str) -> None:
            self.events.append(f"taken {key}")

        def lost(self, key: str, reason: str) -> None:
            self.events.append(f"lost {key}: {reason}")

        def changed(self) -> None:
            self.events.append("changed")

        def availability_changed(self, reason: str | None) -> None:
            self.events.append(f"works: {reason}")

    async def work() -> None:
        watcher = Watcher()
        relay = Relay(watcher)
        relay.attach(asyncio.get_running_loop())

        def tell() -> None:
            relay.availability_changed(None)
            relay.changed()
            relay.taken("x")
            relay.changed()
            relay.lost("x", "it has ended")

        telling = threading.Thread(target=tell)
        telling.start()
        telling.join()
        assert not watcher.events
        await asyncio.sleep(0)
        assert watcher.events == ["works: None", "changed", "taken x", "lost x: it has ended"]
        relay.changed()
        await asyncio.sleep(0)
        assert watcher.events[-1] == "changed"
        relays.append(relay)

    relays: list[Relay] = []
    asyncio.run(work())
    relays[0].taken("y")  # Nobody listens any more.
