"""Which node of a fleet polls which device: a device has a partition, and a partition a node."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping


def partition_of(link: str, partitions: int) -> int:
    """The partition of a link: devices behind one address stay together."""
    return _hash(link) % partitions


def assigned(partitions: int, nodes: Collection[str], held: Mapping[int, str]) -> dict[int, str]:
    """Who should hold each partition; `held` is who does now.

    All nodes have the same number of partitions, or one more. No other assignment of that kind
    moves fewer of those that are held by live nodes. (Rendezvous hashing alone does not spread few
    partitions evenly, and with a limit for each node it moves far more than necessary.)
    """
    if not nodes:
        return {}
    kept: dict[str, list[int]] = {node: [] for node in sorted(nodes)}
    free: list[int] = []
    for partition in range(partitions):
        owned = kept.get(held.get(partition, ""))
        (free if owned is None else owned).append(partition)
    share, more = divmod(partitions, len(kept))
    # Those who have most keep one more, so that nothing moves only because of the remainder.
    order = sorted(kept, key=lambda node: (-len(kept[node]), node))
    shares = {node: share + (place < more) for place, node in enumerate(order)}
    for node, owned in kept.items():
        owned.sort(key=lambda partition: _score(partition, node), reverse=True)
        free += owned[shares[node] :]
        del owned[shares[node] :]
    for partition in sorted(free):
        open_to = (node for node, owned in kept.items() if len(owned) < shares[node])
        kept[max(open_to, key=lambda node: _score(partition, node))].append(partition)
    return {partition: node for node, owned in kept.items() for partition in owned}


def _score(partition: int, node: str) -> int:
    return _hash(f"{partition}/{node}")


def _hash(text: str) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")
