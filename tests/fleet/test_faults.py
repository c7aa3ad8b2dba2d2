"""A fleet whose NATS servers, stored values, connections, clocks or names fail."""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import os
import signal
import sys
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.net.nats.connection import Servers
from holdfast.replication.leases.times import LeaseTimes
from holdfast.scanner.fleet.agreement import FleetRefused
from holdfast.scanner.settings import FleetSettings, Settings
from support import nats_cluster, wire
from support.fleet_nodes import (
    FLEET,
    Commands,
    are_polled,
    known,
    ports_of,
    prepare,
    subscribed,
    wanted,
)
from support.judges import Judges
from support.leases import BRIEF
from support.nats_bus import Caller, Running, logged
from support.scanner_parts import member_of, registry_of
from support.scanner_process import begin_scanner, freeze
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.config.values.scanner_settings import Writes
    from support.brokers import NatsServer
    from support.judges import Judge
    from support.nats_bus import Run
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
    for cluster in nats_cluster.running(tmp_path):
        prepare(cluster.urls[0], PARTITIONS, replicas=3)
        yield cluster


@pytest.fixture
def server(own_nats: NatsServer) -> NatsServer:
    prepare(own_nats.url, PARTITIONS)
    return own_nats


@pytest.fixture
def proxies(server: NatsServer) -> Iterator[list[Proxy]]:
    proxies = [Proxy(server.port, "nats") for _ in range(2)]
    yield proxies
    for proxy in proxies:
        proxy.close()


@pytest.fixture
def node(run_scanner: Run) -> Callable[..., Running]:
    def start(name: str, *urls: str, lease_times: LeaseTimes = BRIEF) -> Running:
        return run_scanner(servers=Servers(urls), fleet=fleet(name, lease_times))

    return start


def fleet(name: str, lease_times: LeaseTimes = BRIEF) -> FleetSettings:
    return FleetSettings(FLEET, name, PARTITIONS, lease_times, check_interval_s=0.5)


def settings(name: str, url: str, writes: Writes = "tags") -> Settings:
    return Settings(Servers((url,)), writes=writes, fleet=fleet(name))


def partitions(running: Running) -> int:
    member = member_of(running.scanner)
    return len(member.partition_leases.partitions)


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


def key_of(device: str) -> str:
    """The key of a device in the bucket of subscriptions."""
    return "device." + base64.urlsafe_b64encode(device.encode()).rstrip(b"=").decode()


def stored(caller: Caller, key: str) -> bytes:
    """A value in the bucket of subscriptions."""

    async def get() -> bytes:
        bucket = await caller.client.jetstream().key_value(WANTS)
        return (await bucket.get(key)).value or b""

    return caller.do(get())


def check(judges: Judges) -> None:
    for judge in judges.devices:
        assert not judge.overlaps
        assert not judge.doubles
        assert not judge.returns()


EVERYTHING = {f"d{number}": ["hmi"] for number in range(DEVICES)}


def test_servers_that_lose_their_storage_get_everything_again(
    server: NatsServer,
    node: Callable[..., Running],
    judges: Judges,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    nodes = [node(name, server.url) for name in "abc"]
    share(*nodes)
    with Caller(server.url) as caller:
        subscribe_all(caller, judges)
        commands = Commands(caller, judges.devices, 20.0, BRIEF)
        server.kill()
        until_left(judges)
        server.lose_store()
        server.start()
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
        share(node("d", server.url))
        until_scanned(judges)
        ended = {"deviceId": "d0", "subscriberId": "hmi", "tagIds": "all"}
        assert caller.request("modbus.unsubscribe", ended) == {"success": True}
        wire.until(lambda: "d0" not in known(caller), "it is gone")
    check(judges)


def test_buckets_that_are_deleted_are_made_again(
    server: NatsServer, node: Callable[..., Running], judges: Judges
) -> None:
    nodes = [node(name, server.url) for name in "ab"]
    share(*nodes)
    with Caller(server.url) as caller:
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
    server: NatsServer, proxies: list[Proxy], node: Callable[..., Running], judges: Judges
) -> None:
    """One node was without NATS while subscriptions changed, and is the first to be back."""
    late, other = (node(name, each.url) for name, each in zip("ab", proxies, strict=True))
    share(late, other)
    with Caller(server.url) as caller:
        subscribe_all(caller, judges)
        registries = [registry_of(running.scanner) for running in (late, other)]
        wire.until(lambda: all(len(each.devices) == DEVICES for each in registries), "known")
        proxies[0].down()
        wire.until(lambda: partitions(other) == PARTITIONS, "the other node has all")
        ended = {"deviceId": "d0", "subscriberId": "hmi", "tagIds": "all"}
        assert caller.request("modbus.unsubscribe", ended)["success"]
        added = wanted(judges.devices[1], 1, subscriberId="trend")
        assert caller.request("modbus.subscribe", added)["success"]
        server.kill()
        proxies[1].down()
        server.lose_store()
        server.start()
        proxies[0].up()
        wire.until(lambda: len(caller.kept(WANTS)) > DEVICES, "what it knows is stored")
        proxies[1].up()
        expected = {**EVERYTHING, "d1": ["hmi", "trend"]}
        del expected["d0"]
        wire.until(lambda: late.serves and other.serves, "they serve")
        for each in registries:
            wire.until(partial(lambda of: subscribers(of) == expected, each), "the newest is known")


def subscribers(registry: Any) -> dict[str, list[str]]:
    return {id: sorted(device.subscribers) for id, device in registry.devices.copy().items()}


def first_of(cluster: NatsCluster, node: Callable[..., Running]) -> Running:
    """A node that has made the buckets: servers may give others no answer meanwhile."""
    first = node("a", *cluster.urls)
    share(first)
    return first


def test_malformed_values_are_logged_and_stop_no_node(
    server: NatsServer,
    node: Callable[..., Running],
    judges: Judges,
    caplog: pytest.LogCaptureFixture,
) -> None:
    values = {
        "d1": b"{",
        "d2": b"7",
        "d3": b'{"requests":[],"renewed":{"\xff":1}}',
        "d4": b'{"requests":[' + b"[" * 5000 + b"]" * 5000 + b"]}",
    }

    def are_logged() -> bool:
        keys = {each["key"] for each in logged(caplog, "kept_entry_malformed")}
        return keys == set(map(key_of, values))

    first = node("a", server.url)
    with Caller(server.url) as caller:
        for number in (0, 1):
            subscribed(caller, number, judges.devices[number], scanRate=100)
        for device, value in values.items():
            caller.put(WANTS, key_of(device), value)
        wire.until(are_logged, "the node that runs has logged all")
        wire.until(lambda: known(caller) == {"d0": ["hmi"]}, "only d0 has subscriptions")
        first.stop()
        caplog.clear()
        share(node("b", server.url))
        wire.until(are_logged, "the node that starts has logged all")
        assert {each["bucket"] for each in logged(caplog, "kept_entry_malformed")} == {WANTS}
        assert known(caller) == {"d0": ["hmi"]}
        # A subscription replaces a malformed value.
        subscribed(caller, 1, judges.devices[1], scanRate=100)
        assert json.loads(stored(caller, key_of("d1")))["requests"]
        polls = [len(judge.polls) for judge in judges.devices[:2]]
        wire.until(partial(are_polled, judges.devices[:2], polls), "both are scanned")
    check(judges)


@pytest.mark.parametrize("value", [b"{", b'{"prefix":"\xff"}', b"[" * 5000])
def test_malformed_terms_are_replaced(
    server: NatsServer, node: Callable[..., Running], value: bytes
) -> None:
    former = node("a", server.url)
    share(former)
    former.stop()
    with Caller(server.url) as caller:
        terms = stored(caller, "terms")
        caller.put(WANTS, "terms", value)
        share(node("b", server.url))
        wire.until(lambda: stored(caller, "terms") == terms, "they are replaced")


def test_without_a_quorum_devices_rest(
    cluster: NatsCluster, node: Callable[..., Running], judges: Judges
) -> None:
    nodes = [first_of(cluster, node), *(node(name, *cluster.urls) for name in "bc")]
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
    cluster: NatsCluster, node: Callable[..., Running], judges: Judges
) -> None:
    nodes = [first_of(cluster, node), node("b", *cluster.urls)]
    share(*nodes)
    registries = [registry_of(running.scanner) for running in nodes]
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
    server: NatsServer,
    proxies: list[Proxy],
    node: Callable[..., Running],
    judges: Judges,
    comes_late: bool,
) -> None:
    """What it has sent meanwhile comes late, or never."""
    [proxy, _] = proxies
    half, other = node("a", proxy.url), node("b", server.url)
    share(half, other)
    with Caller(server.url) as caller:
        subscribe_all(caller, judges)
        commands = Commands(caller, judges.devices, 20.0, BRIEF)
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
    check(judges)


def test_wall_time_may_jump(
    server: NatsServer,
    node: Callable[..., Running],
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    times = LeaseTimes(renewal_s=0.2)
    nodes = [node(name, server.url, lease_times=times) for name in "ab"]
    share(*nodes)
    with Caller(server.url) as caller:
        subscribe_all(caller, judges)
        [timed, *_] = judges.devices
        subscribed(caller, 0, timed, scanRate=100, ttl=3600)
        now = time.time
        taken = [as_member(each).partition_leases.leases.held for each in nodes]
        for jump in (86_400.0, -86_400.0, 0.0):
            monkeypatch.setattr(time, "time", lambda jump=jump: now() + jump)
            monkeypatch.setattr(time, "time_ns", lambda jump=jump: int((now() + jump) * 1e9))
            subscribed(caller, 1, judges.devices[1], scanRate=100, ttl=3600)
            revisions = [
                as_member(each).partition_leases.leases.revision("partition.0") for each in nodes
            ]
            wire.until(partial(are_renewed, nodes, revisions), "leases are renewed")
            until_scanned(judges)
        assert [as_member(each).partition_leases.leases.held for each in nodes] == taken
        assert not logged(caplog, "lease_lost")
        assert not logged(caplog, "expired")
        assert known(caller) == EVERYTHING
    check(judges)


def as_member(running: Running) -> Any:
    return member_of(running.scanner)


def are_renewed(nodes: list[Running], revisions: list[int]) -> bool:
    found: int = sum(
        as_member(each).partition_leases.leases.revision("partition.0") for each in nodes
    )
    return found > sum(revisions)


def test_one_of_two_nodes_with_one_name_is_refused(server: NatsServer, judges: Judges) -> None:
    with Caller(server.url) as caller, both(twin(server), twin(server)) as nodes:
        refused, other = one_refused(nodes)
        assert str(refused) == "another process is the node twin: give it another name"
        subscribe_all(caller, judges)
        assert not other.ended.done()
    check(judges)


def twin(server: NatsServer) -> Settings:
    return settings("twin", server.url)


@contextlib.contextmanager
def both(*of_nodes: Settings) -> Iterator[list[Running]]:
    """Nodes that start at the same time, and may be refused."""
    nodes = list(map(Running, of_nodes))
    try:
        yield nodes
    finally:
        for each in nodes:
            with contextlib.suppress(FleetRefused):
                each.stop()


def one_refused(nodes: list[Running]) -> tuple[BaseException | None, Running]:
    """Waits until one of two nodes ends. Returns its error, and the other node."""
    wire.until(lambda: any(each.ended.done() for each in nodes), "one ends")
    [refused] = [each for each in nodes if each.ended.done()]
    [other] = [each for each in nodes if each is not refused]
    return refused.ended.exception(), other


def test_one_of_two_nodes_with_other_settings_is_refused(
    server: NatsServer, node: Callable[..., Running]
) -> None:
    # They may replace the settings of nodes that have ended.
    former = node("former", server.url)
    share(former)
    former.stop()
    names: tuple[Writes, Writes] = ("explicit", "none")
    with both(*(settings(each, server.url, writes=each) for each in names)) as nodes:
        refused, other = one_refused(nodes)
        [own, theirs] = names if other is nodes[1] else reversed(names)
        assert isinstance(refused, FleetRefused)
        assert str(refused) == f"writes is {own}, and {theirs} in the fleet"
        share(other)


def test_a_stopped_node_ends_when_another_process_has_its_name(
    server: NatsServer, node: Callable[..., Running], judges: Judges, tmp_path: Path
) -> None:
    log = tmp_path / "former.log"
    former = begin_scanner(settings("a", server.url), log)
    try:
        other = node("b", server.url)
        wire.until(lambda: partitions(other) == PARTITIONS // 2, "they share the partitions")
        with Caller(server.url) as caller:
            subscribe_all(caller, judges)
            freeze(former)
            judges.frozen |= ports_of(former.pid)
            wire.until(lambda: partitions(other) == PARTITIONS, "the other node has all")
            nodes = [node("a", server.url), other]
            share(*nodes)
            until_scanned(judges)
            commands = Commands(caller, judges.devices, 50.0, BRIEF)
            former.send_signal(signal.SIGCONT)
            assert former.wait(wire.DEADLINE) == 1
            commands.stop()
            commands.check()
            assert "another process is the node a" in log.read_text()
            share(*nodes)
            until_scanned(judges)
    finally:
        former.kill()
        former.wait()
    check(judges)
