"""A node whose event loop is busy or hangs, and one that loses one of its two connections."""

from __future__ import annotations

import asyncio
import math
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from holdfast.scanner.fleet import partition_leases
from holdfast.scanner.settings import FleetSettings
from support import wire
from support.fleet_nodes import FLEET, prepare
from support.judges import Judges
from support.leases import BRIEF
from support.nats_bus import Caller, logged
from support.scanner_parts import client_of, member_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.scanner.fleet.member import FleetMember
    from support.brokers import NatsServer
    from support.judges import Judge
    from support.nats_bus import Run, Running

PARTITIONS = 8
DEVICES = 4


@pytest.fixture
def node(own_nats: NatsServer, run_scanner: Run) -> Callable[..., Running]:
    prepare(own_nats.url, PARTITIONS)

    def start(name: str, lease_times: LeaseTimes = LEASE_TIMES) -> Running:
        return run_scanner(own_nats, fleet=FleetSettings(FLEET, name, PARTITIONS, lease_times))

    return start


@pytest.fixture
def judges() -> Iterator[Judges]:
    with Judges(DEVICES) as judges:
        yield judges


def as_member(running: Running) -> FleetMember:
    return member_of(running.scanner)


def share(*nodes: Running) -> None:
    """Waits until each node has its share of the partitions."""
    each = [PARTITIONS // len(nodes)] * len(nodes)
    wire.until(
        lambda: [len(as_member(node).partition_leases.partitions) for node in nodes] == each,
        "they are shared",
    )


def subscribe(server: NatsServer, judges: Judges) -> None:
    with Caller(server.url) as caller:
        for number, judge in enumerate(judges.devices):
            tag = {"id": "t", "address": 0, "functionCode": "holding", "datatype": "uint16"}
            request: dict[str, Any] = {
                "deviceId": f"d{number}",
                "host": "127.0.0.1",
                "port": judge.port,
                "scanRate": 100,
                "subscriberId": "hmi",
                "tags": [tag],
            }
            assert caller.request("modbus.subscribe", request)["success"]


def is_polled(judge: Judge, more_than: int) -> bool:
    return len(judge.polls) > more_than


def polled(judges: Judges) -> None:
    """Waits until every device is polled, and checks that one node does."""
    before = [len(judge.polls) for judge in judges.devices]
    for judge, count in zip(judges.devices, before, strict=True):
        wire.until(partial(is_polled, judge, count + 5), "it is polled")
        assert not judge.overlaps
        assert not judge.returns()


def test_a_busy_event_loop_loses_no_device(
    node: Callable[..., Running],
    own_nats: NatsServer,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(partition_leases, "HANG_AFTER_S", math.inf)
    times = LeaseTimes(ttl_s=2.0, hold_s=1.5, renewal_s=0.2)
    one, two = node("a", times), node("b", times)
    share(one, two)
    subscribe(own_nats, judges)
    polled(judges)
    fleet, seen = as_member(one).partition_leases, as_member(two).partition_leases.leases.seen
    held = dict(fleet.leases.held)

    async def be_busy() -> None:
        key = f"partition.{fleet.partitions[0]}"
        revision = seen[key].revision
        # Blocks the event loop for longer than a lease lasts.
        end = time.monotonic() + times.ttl_s
        wire.until(lambda: time.monotonic() > end, "it would have ended")
        wire.until(lambda: seen[key].revision > revision + 10 * len(held), "renewals go on")

    one.do(be_busy())
    polled(judges)
    assert dict(fleet.leases.held) == held
    assert all(len(judge.peers) == 1 for judge in judges.devices)
    assert not logged(caplog, "lease_lost")


def test_others_take_over_from_a_node_whose_event_loop_hangs(
    node: Callable[..., Running], own_nats: NatsServer, judges: Judges
) -> None:
    class Hangs:
        age = math.inf

    one, two = node("a", BRIEF), node("b", BRIEF)
    share(one, two)
    subscribe(own_nats, judges)
    leases = as_member(one).partition_leases
    heartbeat, leases.heartbeat = leases.heartbeat, Hangs()  # type: ignore[assignment]
    share(two)
    polled(judges)
    leases.heartbeat = heartbeat
    share(one, two)
    polled(judges)


def test_others_take_over_from_a_node_that_can_publish_nothing(
    node: Callable[..., Running], own_nats: NatsServer, judges: Judges
) -> None:
    one, two = node("a", BRIEF), node("b", BRIEF)
    share(one, two)
    subscribe(own_nats, judges)
    member, client = as_member(one), client_of(one.scanner)

    async def connected(is_connected: bool) -> None:
        member.connected(client if is_connected else None)

    one.do(connected(False))
    share(two)
    polled(judges)
    one.do(connected(True))
    share(one, two)
    polled(judges)


def test_the_connection_of_leases_is_made_again(
    node: Callable[..., Running], own_nats: NatsServer, judges: Judges
) -> None:
    one, two = node("a"), node("b")
    share(one, two)
    subscribe(own_nats, judges)
    leases, thread = as_member(one).partition_leases.leases, as_member(one).partition_leases._thread
    client = leases._client
    assert client is not None
    assert thread._loop is not None
    asyncio.run_coroutine_threadsafe(client.close(), thread._loop).result(wire.DEADLINE)
    wire.until(lambda: leases._client not in (None, client), "there is another one")
    share(one, two)
    polled(judges)


def test_the_thread_of_leases_ends_with_the_node(node: Callable[..., Running]) -> None:
    one = node("a")
    share(one)
    thread = as_member(one).partition_leases._thread._thread
    assert thread is not None
    assert thread.is_alive()
    one.stop()
    assert not thread.is_alive()
    assert not as_member(one).partition_leases.leases.held
