"""Which node should hold which partition: a simulation of a large fleet."""

from __future__ import annotations

import random
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.scanner.fleet.assignment import assigned, partition_of

DEVICES = 100_000
NODES = 50


def loads(by: dict[int, str], devices: Counter[int]) -> Counter[str]:
    load: Counter[str] = Counter()
    for partition, node in by.items():
        load[node] += devices[partition]
    return load


@pytest.mark.parametrize(("partitions", "most"), [(1024, 0.10), (256, 0.30)])
def test_100_000_devices_move_hardly_more_than_they_must(partitions: int, most: float) -> None:
    """With 256 partitions, a node has 5 or 6: the best that is possible is 17 % above the mean."""
    chance = random.Random(18)
    links = (f"tcp://10.{n >> 16}.{n >> 8 & 255}.{n & 255}:502" for n in range(DEVICES))
    devices = Counter(partition_of(link, partitions) for link in links)
    nodes = [f"node-{number}" for number in range(NODES)]
    by = assigned(partitions, nodes, {})
    ratios, imbalances = [], []
    for step in range(40):
        before, largest = by, len(nodes)
        if step % 2:
            nodes.remove(chance.choice(nodes))
        else:
            nodes.append(f"new-{step}")
            largest = len(nodes)
        by = assigned(partitions, nodes, before)
        moved = sum(devices[each] for each in by if by[each] != before[each])
        ratios.append(moved / (DEVICES / largest))
        imbalances.append(max(loads(by, devices).values()) / (DEVICES / len(nodes)) - 1)
    # A node that leaves may have had one partition more than the mean.
    assert sum(ratios) / len(ratios) <= 1.05
    assert partitions < 1024 or max(ratios) <= 1.2
    assert max(imbalances) < most


@given(
    st.integers(1, 64),
    st.sets(st.sampled_from("abcdefgh"), min_size=1),
    st.dictionaries(st.integers(0, 63), st.sampled_from("abcdefghxyz")),
)
def test_every_partition_has_a_live_node_and_none_moves_in_vain(
    partitions: int, nodes: set[str], held: dict[int, str]
) -> None:
    by = assigned(partitions, nodes, held)
    assert set(by) == set(range(partitions))
    counts = Counter(dict.fromkeys(nodes, 0)) + Counter()
    counts.update(by.values())
    assert set(by.values()) <= nodes
    every = [counts[node] for node in nodes]
    assert max(every) - min(every) <= 1
    # Whoever has less than the largest share has lost nothing.
    for partition, node in held.items():
        if partition < partitions and node in nodes and by[partition] != node:
            assert counts[node] >= partitions // len(nodes)
    assert assigned(partitions, nodes, by) == by


def test_a_node_that_joins_takes_its_share_and_moves_nothing_else() -> None:
    before = assigned(256, ["a", "b", "c"], {})
    after = assigned(256, ["a", "b", "c", "d"], before)
    moved = [partition for partition in after if after[partition] != before[partition]]
    assert len(moved) == 64
    assert {after[partition] for partition in moved} == {"d"}


def test_a_node_that_leaves_gives_only_its_own_away() -> None:
    before = assigned(256, ["a", "b", "c", "d"], {})
    after = assigned(256, ["a", "b", "c"], before)
    assert {before[each] for each in after if after[each] != before[each]} == {"d"}
