"""One node of a fleet: its lease as a node, and the leases of its partitions."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from nats.errors import Error

from holdfast import logs
from holdfast.leases import TTL, Leases
from holdfast.scanner.fleet.placement import partition_of, placed
from holdfast.scanner.fleet.terms import FleetRefused, FleetSettings, Terms

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from nats.aio.client import Client

    from holdfast import _core
    from holdfast.leases import Holding

NODE = "node."
PARTITION = "partition."

TOGETHER = 4
"""Partitions that are handed over at once."""

ENDING = 5.0
"""Seconds to wait for polls and writes of a partition before it is given back."""

SETTLED = 0.05
"""Seconds in which changes are gathered before partitions are placed anew."""

LOOKED = 0.5
"""The longest time in seconds between two looks at which leases have ended."""

JOINING = 2 * TTL
"""Seconds after which the name of a node is in use, if its lease is still renewed."""


def leases_of(fleet: str) -> str:
    """The bucket of the leases of a fleet."""
    return f"holdfast_fleet_{fleet}"


class Fleet:
    """A node. `gained` and `lost` are called with partitions."""

    def __init__(
        self,
        settings: FleetSettings,
        terms: Terms,
        about: Callable[[], dict[str, Any]],
        gained: Callable[[int], None],
        lost: Callable[[int], None],
    ) -> None:
        """`about` returns what others are shown of this node."""
        self.settings = settings
        self.terms = terms
        self._node_about = about
        self._gained = gained
        self._lost = lost
        self._is_leaving = False
        self._news = asyncio.Event()
        self._ending: dict[str, asyncio.Task[None]] = {}
        self._may_end = asyncio.Semaphore(TOGETHER)
        self._started = int(time.time() * 1000)
        self.leases = Leases(
            leases_of(settings.name), settings.node, self, replicas=3, about=self._about
        )

    @property
    def node(self) -> str:
        """The name of this node."""
        return self.settings.node

    @property
    def nodes(self) -> list[str]:
        """The live nodes that don't leave."""
        return sorted(
            name for name, holding in self._live_nodes() if not holding.about.get("leaving")
        )

    @property
    def has_others(self) -> bool:
        """Whether there are other live nodes."""
        return any(name != self.node for name, _ in self._live_nodes())

    def _live_nodes(self) -> Iterable[tuple[str, Holding]]:
        for key in list(self.leases.seen):
            if key.startswith(NODE) and (holder := self.leases.holder(key)) is not None:
                yield key.removeprefix(NODE), holder

    def partition(self, connection: str) -> int:
        """The partition of a connection to devices."""
        return partition_of(connection, self.settings.partitions)

    def fence(self, partition: int) -> _core.Fence:
        """The fence of a partition."""
        return self.leases.fence(f"{PARTITION}{partition}")

    def is_own(self, partition: int) -> bool:
        """Whether this node may use the devices of a partition now. Ask at the last moment."""
        return self.leases.is_held(f"{PARTITION}{partition}")

    @property
    def may_publish(self) -> bool:
        """Whether the node was not stopped for so long that others may poll its devices."""
        return self.leases.is_held(f"{NODE}{self.node}")

    def epoch(self, partition: int) -> int:
        """The revision with which this node took the lease of a partition; 0 without it."""
        return self.leases.held.get(f"{PARTITION}{partition}", 0)

    def revision(self, partition: int) -> int:
        """The latest revision of the lease of a partition that this node has; 0 without it."""
        return self.leases.revision(f"{PARTITION}{partition}")

    def owner(self, partition: int) -> str | None:
        """The node that has the lease of a partition, as far as is known."""
        holder = self.leases.holder(f"{PARTITION}{partition}")
        return None if holder is None else holder.node

    @property
    def partitions(self) -> list[int]:
        """The partitions of this node."""
        return [
            int(key.removeprefix(PARTITION))
            for key in self.leases.held
            if key.startswith(PARTITION)
        ]

    def _about(self, key: str) -> dict[str, Any]:
        if not key.startswith(NODE):
            return {}
        return {
            "started": self._started,
            "leaving": self._is_leaving,
            "total": self.settings.partitions,
            **self._node_about(),
        }

    async def join(self) -> None:
        """Takes the lease of the node. Raises `FleetRefused` if its name is in use."""
        key = f"{NODE}{self.node}"
        self.leases.want([key])
        until = time.monotonic() + JOINING
        while key not in self.leases.held:
            holder = self.leases.holder(key)
            if holder is None or self.leases.reason is not None:
                until = time.monotonic() + JOINING
            elif time.monotonic() > until:
                raise FleetRefused(f"another process is the node {self.node}: give it another name")
            await asyncio.sleep(SETTLED)
        logs.write(
            logging.INFO,
            "fleet_joined",
            fleet=self.settings.name,
            node=self.node,
            nodes=",".join(self.nodes),
        )

    async def run(self) -> None:
        """Holds the partitions that this node should have, until it is cancelled."""
        known: list[str] = []
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOKED):
                    await self._news.wait()
            await asyncio.sleep(SETTLED)
            self._news.clear()
            nodes = self.nodes
            if nodes != known:
                fields = {"fleet": self.settings.name, "nodes": ",".join(nodes)}
                logs.write(logging.INFO, "fleet_changed", **fields)
                known = nodes
            self._place(nodes)

    def _place(self, nodes: list[str]) -> None:
        if self._is_leaving:
            return
        held = {
            partition: owner
            for partition in range(self.settings.partitions)
            if (owner := self.owner(partition)) is not None
        }
        target = placed(self.settings.partitions, nodes, held)
        mine = {f"{PARTITION}{each}" for each, node in target.items() if node == self.node}
        self.leases.want([f"{NODE}{self.node}", *mine])
        for key in self.leases.held:
            if key.startswith(PARTITION) and key not in mine and key not in self._ending:
                task = asyncio.create_task(self._give_back(key, self._may_end))
                self._ending[key] = task
                task.add_done_callback(partial(self._ended, key))

    def _ended(self, key: str, _: object) -> None:
        self._ending.pop(key, None)

    async def _give_back(self, key: str, may_end: asyncio.Semaphore) -> None:
        async with may_end:
            await self.leases.give_back(key, ENDING)
        self._lost(int(key.removeprefix(PARTITION)))

    async def leave(self) -> None:
        """Hands all partitions over, and ends the lease of the node."""
        self._is_leaving = True
        self.leases.want([])
        node = f"{NODE}{self.node}"
        with contextlib.suppress(Error, OSError):
            await self.leases.renew_now(node)
        keys = [key for key in self.leases.held if key.startswith(PARTITION)]
        may_end = asyncio.Semaphore(len(keys))
        await asyncio.gather(*(self._give_back(key, may_end) for key in keys))
        await self.leases.give_back(node, 0.0)
        logs.write(logging.INFO, "fleet_left", fleet=self.settings.name, node=self.node)

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self.leases.connected(client)

    def taken(self, key: str) -> None:
        """A lease was taken."""
        self._news.set()
        if key.startswith(PARTITION):
            self._gained(int(key.removeprefix(PARTITION)))

    def lost(self, key: str, reason: str) -> None:
        """A lease is not held any more."""
        self._news.set()
        logs.refused("lease_lost", kind="lease", fleet=self.settings.name, lease=key, reason=reason)
        if key.startswith(PARTITION):
            self._lost(int(key.removeprefix(PARTITION)))

    def changed(self) -> None:
        """Somebody else has taken or left a lease."""
        self._news.set()

    def works(self, reason: str | None) -> None:
        """The bucket of leases works; or it does not, for this reason."""
        if reason is None:
            logs.write(logging.INFO, "leases_available", fleet=self.settings.name)
        else:
            logs.write(
                logging.WARNING, "leases_unavailable", fleet=self.settings.name, reason=reason
            )
