"""The order that a history implies between operations on several blocks, as a graph.

One request may read or write several blocks at one moment. Each block may be linearizable by
itself, and still no order of all operations may explain what was seen: one reader saw the new value
of one block and the old one of another, a second reader the opposite. The graph has an edge
wherever one operation certainly comes before another one. A cycle is a violation. For several
blocks, the reverse does not hold: whether there is an order is NP-complete.

The number of edges grows with the number of operations only: operations that end before others
begin are connected by a chain of times, and so are the values of a block.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from typing import TYPE_CHECKING

from oracle.violation import Violation

if TYPE_CHECKING:
    from collections.abc import Iterable

    from oracle.history import Operation
    from oracle.registers import Cluster

    Moment = tuple[float, int]


class Precedence:
    """A graph whose first nodes are the operations, by their index."""

    def __init__(self, operations: list[Operation]) -> None:
        self._operations = operations
        self._number = {operation: at for at, operation in enumerate(operations)}
        self._edges: list[list[int]] = [[] for _ in operations]
        self._chain(
            [(operation.end, self._number[operation]) for operation in operations],
            [(operation.begin, self._number[operation]) for operation in operations],
        )

    def add(self, clusters: Iterable[Cluster]) -> None:
        """Adds the order of the values of a block, which is linearizable by itself."""
        entries: dict[Cluster, int] = {}
        exits: dict[Cluster, int] = {}
        for cluster in clusters:
            exits[cluster] = self._node()
            if cluster.write is not None:
                entries[cluster] = self._number[cluster.write]
                self._edges[entries[cluster]].append(exits[cluster])
            for read in cluster.reads:
                number = self._number[read]
                self._edges[number].append(exits[cluster])
                if cluster in entries and number != entries[cluster]:
                    self._edges[entries[cluster]].append(number)
        forward = sorted((each for each in exits if each.is_forward), key=lambda one: one.first_end)
        for before, after in itertools.pairwise(forward):
            # The value that was there before the first operation has no entry, and is the first.
            self._edges[exits[before]].append(entries[after])
        backward = [each for each in exits if not each.is_forward]
        ends = {cluster: (cluster.first_end, exits[cluster]) for cluster in exits}
        begins = {cluster: (cluster.last_begin, entries[cluster]) for cluster in entries}
        # A forward cluster ends before it begins, in this sense, so it must not be in both lists.
        self._chain(ends.values(), [begins[each] for each in backward if each in begins])
        self._chain(
            [ends[each] for each in backward], [begins[each] for each in forward if each in begins]
        )

    def cycle(self) -> Violation | None:
        """Operations of which each comes before the next, and the last before the first."""
        waiting = [0] * len(self._edges)
        for targets in self._edges:
            for target in targets:
                waiting[target] += 1
        ready = deque(node for node, count in enumerate(waiting) if count == 0)
        left = len(self._edges)
        while ready:
            left -= 1
            for target in self._edges[ready.popleft()]:
                waiting[target] -= 1
                if waiting[target] == 0:
                    ready.append(target)
        if left == 0:
            return None
        return Violation(
            "order", "no order of these operations explains what they saw", self._found(waiting)
        )

    def _found(self, waiting: list[int]) -> tuple[Operation, ...]:
        """Walks backwards among the nodes that can't be ordered, until one comes again."""
        before: dict[int, int] = {}
        for node, targets in enumerate(self._edges):
            if waiting[node]:
                before.update(dict.fromkeys((at for at in targets if waiting[at]), node))
        node, path = next(iter(before)), dict[int, None]()
        while node not in path:
            path[node] = None
            node = before[node]
        nodes = list(path)
        cycle = reversed(nodes[nodes.index(node) :])
        return tuple(self._operations[at] for at in cycle if at < len(self._operations))

    def _node(self) -> int:
        self._edges.append([])
        return len(self._edges) - 1

    def _chain(self, ends: Iterable[Moment], begins: Iterable[Moment]) -> None:
        """Connects each node that ends with all that begin later, by nodes for times between."""
        events = [(time, 1, node) for time, node in ends if not math.isinf(time) or time < 0]
        events += [(time, 0, node) for time, node in begins]
        latest: int | None = None
        for _, is_end, node in sorted(events):
            if is_end:
                following = self._node()
                if latest is not None:
                    self._edges[latest].append(following)
                self._edges[node].append(following)
                latest = following
            elif latest is not None:
                self._edges[latest].append(node)
