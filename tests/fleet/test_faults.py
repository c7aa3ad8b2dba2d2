"""A fleet whose NATS servers, connections, clocks or names fail."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.scanner import FleetSettings, Servers
from support import nats_cluster, wire
from support.fleet_nodes import Commands, Nodes, are_polled, known, subscribed, wanted
from support.judges import Judges
from support.nats_bus import Caller, logged
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from support.brokers import NatsServer
    from support.judges import Judge
    from support.nats_bus import Run, Running
    from support.nats_cluster import NatsCluster

IS_LONG = os.environ.get("HOLDFAST_TORTURE") == "1"
PARTITIONS = 16
DEVICES = 6
WANTS = "holdfast_fleet_plant_wants"
LEASES = "holdfast_fleet_plant"

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="reads states of connections"),
    # nats-py does not close the socket of a server that ends while it connects.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def judges() -> Iterator[Judges]:
    with Judges(DEVICES) as judges:
        yield judges


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[NatsCluster]:
    yield from nats_cluster.running(tmp_path)


@pytest.fixture
def node(run_scanner: Run) -> Callable[..., Running]:
    def start(name: str, *urls: str) -> Running:
        fleet = FleetSettings("plant", name, PARTITIONS)
        return run_scanner(servers=Servers(urls), fleet=fleet)

    return start


def partitions(running: Running) -> int:
    part = running.scanner._part
    assert part is not None
    return len(part.fleet.partitions)


def share(*nodes: Running) -> None:
    """Waits until all partitions have a node, and each node has its share."""
    wire.until(lambda: sum(map(partitions, nodes)) == PARTITIONS, "all have a node")
    wire.until(lambda: min(map(partitions, nodes)) >= PARTITIONS // len(nodes), "all have some")


def subscribe_all(caller: Caller, judges: Judges) -> None:
    for number, judge in enumerate(judges.devices):
        subscribed(caller, number, judge, scanRate=100)
    until_scanned(judges)


def until_scanned(judges: Judges) -> None:
    counts = [len(judge.polls) + 2 for judge in judges.devices]
    wire.until(partial(are_polled, judges.devices, counts), "all are scanned")


def until_left(judges: Judges) -> None:
    """Waits until there is no connection to any device."""
    wire.until(lambda: not any(map(is_used, judges.devices)), "all connections are closed")


def is_used(judge: Judge) -> bool:
    return judge.is_connected() or judge.busy is not None


def check(judges: Judges) -> None:
    for judge in judges.devices:
        assert not judge.overlaps
        assert not judge.doubles
        assert not judge.returns()


EVERYTHING = {f"d{number}": ["hmi"] for number in range(DEVICES)}


def test_servers_that_lose_their_storage_get_everything_again(
    node: Callable[..., Running],
    own_nats: NatsServer,
    judges: Judges,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    nodes = [node(name, own_nats.url) for name in "abc"]
    share(*nodes)
    with Caller(own_nats.url) as caller:
        subscribe_all(caller, judges)
        commands = Commands(caller, judges.devices, 20.0)
        own_nats.kill()
        until_left(judges)
        own_nats.lose_store()
        own_nats.start()
        wire.until(lambda: all(each.serves for each in nodes), "they serve")
        share(*nodes)
        until_scanned(judges)
        wire.until(lambda: len(caller.kept(WANTS)) > DEVICES, "all is stored")
        assert known(caller) == EVERYTHING
        commands.stop()
        commands.check()
        lost = logged(caplog, "fleet_storage_lost")
        assert {each["devices"] for each in lost} == {DEVICES}
        restored = [each["devices"] for each in logged(caplog, "subscriptions_restored")]
        assert sum(restored) == DEVICES
        # A node that starts now finds them, and changes reach all.
        for each in nodes:
            each.stop()
        share(node("d", own_nats.url))
        until_scanned(judges)
        reply = caller.request("modbus.unsubscribe", {"deviceId": "d0", "subscriberId": "hmi"})
        assert reply == {"success": True}
        wire.until(lambda: "d0" not in known(caller), "it is gone")
    check(judges)


def test_buckets_that_are_deleted_are_made_again(
    node: Callable[..., Running], own_nats: NatsServer, judges: Judges
) -> None:
    nodes = [node(name, own_nats.url) for name in "ab"]
    share(*nodes)
    with Caller(own_nats.url) as caller:
        subscribe_all(caller, judges)
        for bucket in (WANTS, LEASES):
            caller.do(caller.client.jetstream().delete_stream(f"KV_{bucket}"))
        wire.until(lambda: len(caller.kept(WANTS)) > DEVICES, "all is stored")
        wire.until(lambda: len(caller.kept(LEASES)) > PARTITIONS, "all leases are taken")
        share(*nodes)
        until_scanned(judges)
        assert known(caller) == EVERYTHING
    check(judges)


def test_the_newest_of_what_nodes_know_is_restored(
    node: Callable[..., Running], own_nats: NatsServer, judges: Judges
) -> None:
    """One node was without NATS while subscriptions changed, and is the first to be back."""
    proxies = [Proxy(own_nats.port, "nats") for _ in range(2)]
    try:
        late, other = (node(name, each.url) for name, each in zip("ab", proxies, strict=True))
        share(late, other)
        with Caller(own_nats.url) as caller:
            subscribe_all(caller, judges)
            registries = [running.scanner._registry for running in (late, other)]
            wire.until(lambda: all(len(each.devices) == DEVICES for each in registries), "known")
            proxies[0].down()
            wire.until(lambda: partitions(other) == PARTITIONS, "the other node has all")
            ended = {"deviceId": "d0", "subscriberId": "hmi"}
            assert caller.request("modbus.unsubscribe", ended)["success"]
            added = wanted(judges.devices[1], 1, subscriberId="trend")
            assert caller.request("modbus.subscribe", added)["success"]
            own_nats.kill()
            proxies[1].down()
            own_nats.lose_store()
            own_nats.start()
            proxies[0].up()
            wire.until(lambda: len(caller.kept(WANTS)) > DEVICES, "what it knows is stored")
            proxies[1].up()
            expected = {**EVERYTHING, "d1": ["hmi", "trend"]}
            del expected["d0"]
            wire.until(lambda: late.serves and other.serves, "they serve")
            for each in registries:
                wire.until(
                    partial(lambda of: subscribers(of) == expected, each), "the newest is known"
                )
    finally:
        for proxy in proxies:
            proxy.close()


def subscribers(registry: Any) -> dict[str, list[str]]:
    return {id: sorted(device.subscribers) for id, device in registry.devices.copy().items()}


def test_without_a_quorum_devices_rest(
    node: Callable[..., Running], cluster: NatsCluster, judges: Judges
) -> None:
    nodes = [node(name, *cluster.urls) for name in "abc"]
    share(*nodes)
    with Caller(cluster.urls) as caller:
        subscribe_all(caller, judges)
        ended = list(cluster.servers.values())[:2]
        for server in ended:
            server.kill()
        until_left(judges)
        polls = [len(judge.polls) for judge in judges.devices]
        wire.until(lambda: not any(map(partitions, nodes)), "no node has a lease")
        if IS_LONG:
            threading.Event().wait(30)
        for server in ended:
            assert [len(judge.polls) for judge in judges.devices] == polls
            server.start()
        cluster.until_whole(f"KV_{LEASES}")
        share(*nodes)
        until_scanned(judges)
        wire.until(lambda: all(each.serves for each in nodes), "they serve")
        assert known(caller) == EVERYTHING
    check(judges)


def test_a_subscription_reaches_all_nodes_after_a_server_has_ended(
    node: Callable[..., Running], cluster: NatsCluster, judges: Judges
) -> None:
    nodes = [node(name, *cluster.urls) for name in "ab"]
    share(*nodes)
    registries = [running.scanner._registry for running in nodes]
    with Caller(cluster.urls) as caller:
        # Each server may be the one that sends changes to a node that is connected elsewhere.
        for number, server in enumerate(list(cluster.servers.values())):
            server.kill()
            subscribed(caller, number, judges.devices[number], scanRate=100)
            for each in registries:
                wire.until(partial(has, each, f"d{number}"), "it is known")
            server.start()
            cluster.until_whole(f"KV_{WANTS}")


def has(registry: Any, device: str) -> bool:
    return device in registry.devices


@pytest.mark.parametrize("comes_late", [True, False])
def test_a_node_whose_connection_is_half_open_is_replaced(
    node: Callable[..., Running], own_nats: NatsServer, judges: Judges, comes_late: bool
) -> None:
    """What it has sent meanwhile comes late, or never."""
    proxy = Proxy(own_nats.port, "nats")
    try:
        half, other = node("a", proxy.url), node("b", own_nats.url)
        share(half, other)
        with Caller(own_nats.url) as caller:
            subscribe_all(caller, judges)
            commands = Commands(caller, judges.devices, 20.0)
            proxy.hold()
            wire.until(lambda: partitions(other) == PARTITIONS, "the other node has all")
            wire.until(lambda: not partitions(half), "it has none")
            until_scanned(judges)
            if not comes_late:
                proxy.down()
            proxy.go_on()
            proxy.up()
            share(half, other)
            until_scanned(judges)
            commands.stop()
            commands.check()
    finally:
        proxy.close()
    check(judges)


def test_wall_time_may_jump(
    node: Callable[..., Running],
    own_nats: NatsServer,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    nodes = [node(name, own_nats.url) for name in "ab"]
    share(*nodes)
    with Caller(own_nats.url) as caller:
        subscribe_all(caller, judges)
        [timed, *_] = judges.devices
        subscribed(caller, 0, timed, scanRate=100, ttl=3600)
        now = time.time
        taken = [part_of(each).fleet.leases.held for each in nodes]
        for jump in (86_400.0, -86_400.0, 0.0):
            monkeypatch.setattr(time, "time", lambda jump=jump: now() + jump)
            monkeypatch.setattr(time, "time_ns", lambda jump=jump: int((now() + jump) * 1e9))
            subscribed(caller, 1, judges.devices[1], scanRate=100, ttl=3600)
            revisions = [part_of(each).fleet.leases.revision("partition.0") for each in nodes]
            wire.until(partial(are_renewed, nodes, revisions), "leases are renewed")
            until_scanned(judges)
        assert [part_of(each).fleet.leases.held for each in nodes] == taken
        assert not logged(caplog, "lease_lost")
        assert not logged(caplog, "expired")
        assert known(caller) == EVERYTHING
    check(judges)


def part_of(running: Running) -> Any:
    assert running.scanner._part is not None
    return running.scanner._part


def are_renewed(nodes: list[Running], revisions: list[int]) -> bool:
    found: int = sum(part_of(each).fleet.leases.revision("partition.0") for each in nodes)
    return found > sum(revisions)


def test_one_of_two_nodes_with_one_name_is_refused(
    own_nats: NatsServer, judges: Judges, tmp_path: Path
) -> None:
    nodes = Nodes([own_nats.url], tmp_path, PARTITIONS)
    with Caller(own_nats.url) as caller:
        both = [nodes.begin("twin"), nodes.begin("twin")]
        try:
            wire.until(lambda: any(each.poll() is not None for each in both), "one ends")
            [refused] = [each for each in both if each.poll() is not None]
            assert refused.returncode == 2
            assert "another process is the node twin: give it another name" in nodes.log("twin")
            subscribe_all(caller, judges)
            assert [each.poll() for each in both].count(None) == 1
        finally:
            for each in both:
                each.kill()
                each.wait()
    check(judges)


def test_one_of_two_nodes_with_other_settings_is_refused(
    own_nats: NatsServer, tmp_path: Path
) -> None:
    nodes = Nodes([own_nats.url], tmp_path, PARTITIONS)
    # They may replace the settings of nodes that have ended.
    nodes.start("former")
    nodes.settle()
    nodes.stop()
    nodes.running.clear()
    wire.until(lambda: not nodes.shown(), "nobody is left")
    both = {name: nodes.begin(name, more=["--writes", name]) for name in ("explicit", "none")}
    try:
        wire.until(lambda: any(each.poll() is not None for each in both.values()), "one ends")
        [refused] = [name for name, each in both.items() if each.poll() is not None]
        assert both[refused].returncode == 2
        [other] = set(both) - {refused}
        assert f"writes is {refused}, and {other} in the fleet" in nodes.log(refused)
        wire.until(lambda: nodes.shown() == [other], "the other one is the fleet")
    finally:
        for each in both.values():
            each.kill()
            each.wait()


def test_a_stopped_node_ends_when_another_process_has_its_name(
    own_nats: NatsServer, judges: Judges, tmp_path: Path
) -> None:
    nodes = Nodes([own_nats.url], tmp_path, PARTITIONS)
    with Caller(own_nats.url) as caller:
        try:
            nodes.start("a")
            nodes.start("b")
            nodes.settle()
            subscribe_all(caller, judges)
            judges.frozen |= nodes.freeze("a")
            former = nodes.running.pop("a")
            wire.until(lambda: nodes.shown() == ["b"], "the other node has all")
            nodes.start("a")
            nodes.settle()
            until_scanned(judges)
            commands = Commands(caller, judges.devices, 50.0)
            nodes.resume(former)
            assert former.wait(wire.DEADLINE) == 2
            commands.stop()
            commands.check()
            assert "another process is the node a" in nodes.log("a")
            nodes.settle()
            until_scanned(judges)
        finally:
            former.kill()
            former.wait()
            nodes.stop()
    check(judges)
