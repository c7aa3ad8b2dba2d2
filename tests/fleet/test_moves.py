"""Nodes that are stopped, killed, drained and started at random, and NATS servers that die.

The devices judge. In short by default; with HOLDFAST_TORTURE=1 for long, with many devices, and
with the times that the documentation promises. HOLDFAST_SEED repeats a run.
"""

from __future__ import annotations

import os
import random
import sys
import threading
import time
from contextlib import ExitStack
from functools import partial
from statistics import median, quantiles
from typing import TYPE_CHECKING

import pytest

from holdfast.replication.leases.times import LEASE_TIMES
from support import nats_cluster, wire
from support.fleet_nodes import Commands, Nodes, Published, are_polled, known, subscribed
from support.judges import Judges
from support.nats_bus import Caller

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from support.judges import Judge
    from support.nats_cluster import NatsCluster

IS_LONG = os.environ.get("HOLDFAST_TORTURE") == "1"
DEVICES = 1000 if IS_LONG else 40
EACH = 20 if IS_LONG else 1
PARTITIONS = 256 if IS_LONG else 64
RATE = 20.0
"""Commands a second."""

GAP = 5.0
"""Seconds without a scan that are promised, for devices that are scanned every second."""

LEADERLESS = 15.0
"""The same, if the NATS server ends that leads the bucket of leases: others elect a new one, which
takes 4 to 9 s, and longer if they vote twice."""

FROZEN = (1.5, 2.5, 5.0, 8.0) if IS_LONG else (5.0,)
"""Seconds for which nodes are stopped: shorter and longer than a lease lasts."""

DEATHS = 50
RESTING = 200
"""Deaths of the server that leads the leases, and devices that are scanned meanwhile, in the long
form."""

LEASES = "KV_holdfast_fleet_plant"


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[NatsCluster]:
    yield from nats_cluster.running(tmp_path)


class Plant:
    """The cluster, the nodes and the devices, and everything that happens to them."""

    def __init__(
        self, cluster: NatsCluster, nodes: Nodes, judges: Judges, chance: random.Random
    ) -> None:
        self.cluster = cluster
        self.nodes = nodes
        self.judges = judges
        self.scanned: list[Judge] = []
        """The devices that are subscribed."""
        self._chance = chance

    @property
    def kinds(self) -> dict[str, Callable[[], None]]:
        return {
            "kill": self.kill,
            "freeze": self.freeze,
            "drain": self.drain,
            "start": self.start,
            "leader": self.lose_leader,
        }

    def _any(self) -> str:
        return self._chance.choice(sorted(self.nodes.running))

    def start(self) -> None:
        self.nodes.start()

    def kill(self) -> None:
        name = self._any()
        self.nodes.kill(name)
        # A supervisor starts it again, under the same name.
        self.nodes.start(self._chance.choice([name, None]))

    def drain(self) -> None:
        self.nodes.drain(self._any())

    def freeze(self) -> None:
        name = self._any()
        seconds = self._chance.choice(FROZEN)
        began = time.monotonic()
        connections = self.nodes.freeze(name)
        self.judges.frozen |= connections
        try:
            if seconds > LEASE_TIMES.ttl_s:
                wire.until(partial(self.nodes.have_replaced, name), "taken over")
            threading.Event().wait(max(began + seconds - time.monotonic(), 0))
            before = [len(judge.polls) for judge in self.scanned]
        finally:
            self.nodes.thaw(name)
        self.nodes.settle()
        if seconds > LEASE_TIMES.ttl_s:
            # All that it has sent had been received when the others had taken over.
            for judge, count in zip(self.scanned, before, strict=True):
                late = {judge.peers[number] for _, number in judge.polls[count:]}
                assert not [each for each in late if (each, judge.port) in connections]
        self.until_scanned()
        self.judges.frozen.clear()

    def lose_leader(self) -> None:
        name = self.cluster.leader(LEASES)
        self.cluster.servers[name].kill()
        self.nodes.settle()
        self.until_scanned()
        self.cluster.servers[name].start()
        self.cluster.until_whole(LEASES)

    def subscribe(self, caller: Caller, count: int) -> None:
        for _ in range(count):
            number = len(self.scanned)
            subscribed(caller, number, self.judges.devices[number])
            self.scanned.append(self.judges.devices[number])

    def until_scanned(self) -> None:
        counts = [len(judge.polls) + 1 for judge in self.scanned]
        wire.until(partial(are_polled, self.scanned, counts), "all devices are scanned")

    def check(self) -> None:
        for number, judge in enumerate(self.judges.devices):
            assert not judge.doubles, (number, judge.doubles)
            assert not judge.overlaps, number
            assert not judge.returns(), number


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.usefixtures("many_files")
@pytest.mark.timeout(3600 if IS_LONG else 300)
def test_devices_are_scanned_by_one_node_at_a_time_whatever_happens(
    cluster: NatsCluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seed = int(os.environ.get("HOLDFAST_SEED") or (time.time() if IS_LONG else 18))

    def say(text: str) -> None:
        with capsys.disabled() if IS_LONG else ExitStack():
            print(text, flush=True)

    say(f"\nHOLDFAST_SEED={seed}")
    chance = random.Random(seed)
    gaps: dict[str, list[float]] = {}
    with ExitStack() as ending:
        judges = ending.enter_context(Judges(DEVICES))
        caller = ending.enter_context(Caller(cluster.urls))
        nodes = Nodes(cluster.urls, tmp_path, PARTITIONS)
        ending.callback(nodes.stop)
        plant = Plant(cluster, nodes, judges, chance)
        for _ in range(3):
            nodes.start()
        nodes.settle()
        plant.subscribe(caller, DEVICES // 2)
        plant.until_scanned()
        published = Published(caller)
        commands = Commands(caller, list(plant.scanned), RATE)
        ending.callback(commands.stop)
        kinds = [kind for _ in range(EACH) for kind in chance.sample(list(plant.kinds), 5)]
        for place, kind in enumerate(kinds):
            if len(nodes.running) < 2:
                nodes.start()
                nodes.settle()
            began = time.monotonic()
            plant.kinds[kind]()
            nodes.settle()
            plant.until_scanned()
            gap = max(judge.longest_gap(began) for judge in plant.scanned)
            gaps.setdefault(kind, []).append(gap)
            say(f"{place + 1:3} {kind:7} {gap:5.2f} s  {len(nodes.running)} nodes")
            plant.check()
            # More subscriptions come while things happen.
            plant.subscribe(caller, (DEVICES - len(plant.scanned)) // (len(kinds) - place))
            plant.until_scanned()
        commands.stop()
        say(f"commands: {commands.check()}")
        for kind, found in sorted(gaps.items()):
            say(f"{kind:7} longest {max(found):5.2f} s, median {median(found):.2f} s")
        assert known(caller) == {f"d{number}": ["hmi"] for number in range(DEVICES)}
        assert published.count
        assert not published.returns
        assert not published.older
        if IS_LONG:
            for kind, found in gaps.items():
                assert max(found) <= (LEADERLESS if kind == "leader" else GAP), kind


@pytest.mark.skipif(not IS_LONG, reason="ten minutes: HOLDFAST_TORTURE=1 runs it")
@pytest.mark.usefixtures("many_files")
@pytest.mark.timeout(7200)
def test_devices_do_not_rest_longer_than_promised_when_the_leader_of_the_leases_dies(
    cluster: NatsCluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rests: list[float] = []
    with ExitStack() as ending:
        judges = ending.enter_context(Judges(RESTING))
        caller = ending.enter_context(Caller(cluster.urls))
        nodes = Nodes(cluster.urls, tmp_path, PARTITIONS)
        ending.callback(nodes.stop)
        plant = Plant(cluster, nodes, judges, random.Random())
        for _ in range(3):
            nodes.start()
        nodes.settle()
        plant.subscribe(caller, RESTING)
        for place in range(DEATHS):
            plant.until_scanned()
            server = cluster.servers[cluster.leader(LEASES)]
            server.kill()
            began = time.monotonic()
            cluster.leader(LEASES)  # Until there is another one.
            plant.until_scanned()
            nodes.settle()
            rests.append(max(judge.longest_gap(began) for judge in plant.scanned))
            with capsys.disabled():
                print(f"{place + 1:3} {rests[-1]:5.2f} s without a scan", flush=True)
            plant.check()
            server.start()
            cluster.until_whole(LEASES)
    with capsys.disabled():
        parts = [min(rests), *quantiles(rests, n=20)[9::9], max(rests)]
        summary = "shortest {:.2f} s, median {:.2f}, 95 % {:.2f}, longest {:.2f}".format(*parts)
        print(f"{summary}, of {len(rests)} deaths")
    assert max(rests) <= LEADERLESS


@pytest.mark.skipif(not IS_LONG, reason="a minute: HOLDFAST_TORTURE=1 runs it")
@pytest.mark.usefixtures("many_files")
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("leads", [True, False])
def test_values_that_a_frozen_server_sends_late_have_smaller_numbers(
    cluster: NatsCluster, tmp_path: Path, capsys: pytest.CaptureFixture[str], leads: bool
) -> None:
    """If it leads the leases, all nodes lose them; otherwise, nodes keep them."""
    with ExitStack() as ending:
        judges = ending.enter_context(Judges(RESTING))
        nodes = Nodes(cluster.urls, tmp_path, PARTITIONS)
        ending.callback(nodes.stop)
        plant = Plant(cluster, nodes, judges, random.Random())
        for _ in range(3):
            nodes.start()
        nodes.settle()
        leader = cluster.leader(LEASES)
        other = next(name for name in cluster.servers if name != leader)
        frozen, listening = (leader, other) if leads else (other, leader)
        caller = ending.enter_context(Caller(cluster.servers[listening].url))
        plant.subscribe(caller, RESTING)
        plant.until_scanned()
        published = Published(caller)
        began = time.monotonic()
        cluster.servers[frozen].freeze()
        try:
            wire.until(lambda: cluster.leader(LEASES) != frozen, "another server leads")
            threading.Event().wait(FROZEN[-1])
            plant.until_scanned()
        finally:
            cluster.servers[frozen].thaw()
        seconds, count = time.monotonic() - began, published.count
        cluster.until_whole(LEASES)
        nodes.settle()
        plant.until_scanned()
        with capsys.disabled():
            late = len(published.returns) + len(published.older)
            print(f"{late} values behind newer ones, frozen for {seconds:.1f} s")
        assert published.count > count
        assert not published.older
