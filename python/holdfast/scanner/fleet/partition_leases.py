"""The leases of one node of a fleet: that of its name, and those of its partitions.

`assigned` says which node should hold which partition, and says the same on every node. A node that
can't use its devices renews no lease, so that others take them.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any

from holdfast.events import log_lines
from holdfast.replication.leases.leases import Leases
from holdfast.replication.leases.thread import LeaseThread, Relay
from holdfast.runtime import tasks
from holdfast.runtime.heartbeat import Heartbeat
from holdfast.scanner.fleet.agreement import FleetRefused, Terms, digest
from holdfast.scanner.fleet.assignment import assigned
from holdfast.scanner.fleet.handover import Handover
from holdfast.scanner.settings import FleetSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from holdfast import _core
    from holdfast.replication.leases.bucket import Holding
    from holdfast.replication.leases.thread import Connect, StartThread

NODE = "node."
PARTITION = "partition."

GATHER_S = 0.05
"""Time in which changes are gathered before partitions are placed anew."""

CHECK_INTERVAL_S = 0.5
"""The longest time between two looks at which leases have ended."""

HANG_AFTER_S = 5.0
"""Time without a sign of life of the event loop after which leases are not renewed."""


def leases_of(fleet: str) -> str:
    """The bucket of the leases of a fleet."""
    return f"holdfast_fleet_{fleet}"


class PartitionLeases:
    """A node. `gained` and `lost` are called with partitions, in the event loop of `start`.

    The leases are held by a thread of their own: this loop may be busy for seconds.
    """

    def __init__(
        self,
        settings: FleetSettings,
        terms: Terms,
        about: Callable[[], dict[str, Any]],
        gained: Callable[[int], None],
        lost: Callable[[int], None],
        *,
        connect: Connect,
        start_thread: StartThread,
    ) -> None:
        """`about` returns what others are shown of this node.

        `connect` makes the connection of the leases, `start_thread` starts their thread.
        """
        self.heartbeat = Heartbeat()
        """The heartbeat of the event loop of `start`."""
        self._is_connected = False
        self.settings, self.node = settings, settings.node
        self._key = f"{NODE}{self.node}"
        self.terms = terms
        self._terms_digest = digest(terms.encoded())
        self._node_about = about
        self._gained = gained
        self._lost = lost
        self._is_leaving = False
        self._has_changed = asyncio.Event()
        self._started = int(time.time() * 1000)
        self._named_since = time.monotonic()
        """When no other process had the name of this node, the last time."""
        self._begun: dict[int, int] = {}
        """The partitions whose devices are used, with the revision of the lease."""
        self._epochs: dict[int, int] = {}
        self._shown: dict[str, Any] = {}
        self._shown_at = 0.0
        self._relay = Relay(self)
        self.leases = Leases(
            leases_of(settings.name),
            settings.node,
            self._relay,
            times=settings.lease_times,
            replicas=3,
            about=self._about,
            withheld=self._withheld,
        )
        self._thread = LeaseThread(self.leases, connect, "holdfast-leases", start_thread)
        self._handover = Handover(self._thread, self._settle)

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

    def has_terms(self, terms: bytes) -> bool:
        """Whether another live node has these terms."""
        shown = (each.about.get("terms") for _, each in self._live_nodes() if self.is_other(each))
        return digest(terms) in shown

    def _live_nodes(self) -> Iterable[tuple[str, Holding]]:
        for key in self.leases.seen.copy():
            if key.startswith(NODE) and (holder := self.leases.holder(key)) is not None:
                yield key.removeprefix(NODE), holder

    def fence(self, partition: int) -> _core.Fence:
        """The fence of a partition."""
        return self.leases.fence(f"{PARTITION}{partition}")

    def is_own(self, partition: int) -> bool:
        """Whether this node may use the devices of a partition now. Ask at the last moment."""
        key, begun = f"{PARTITION}{partition}", self._begun.get(partition)
        # It may have been lost and taken again since this loop has heard of it.
        return begun is not None and self.leases.since(key) == begun and self.leases.is_held(key)

    @property
    def may_publish(self) -> bool:
        """Whether the node was not stopped for so long that others may poll its devices."""
        return self.leases.is_held(self._key)

    def epoch(self, partition: int) -> int:
        """The number of messages about the devices of a partition; 0 without its lease.

        It is the revision of the lease when this node took it, or last connected after that.
        """
        return self._epochs.get(partition, 0)

    def _withheld(self) -> str | None:
        """Why this node can't publish values, though it could renew its leases."""
        if not self._is_connected:
            return "the other connection to NATS was lost"
        if self.heartbeat.age > HANG_AFTER_S:
            return f"the event loop hangs for {HANG_AFTER_S:g} s"
        return None

    def connected(self, *, is_connected: bool) -> None:
        """The connection that publishes values was made or lost.

        Gives messages greater numbers than those sent over the former connection: a server that was
        frozen sends older messages when it continues.
        """
        self._is_connected = is_connected
        if not is_connected:
            return
        for partition, epoch in self._epochs.items():
            self._epochs[partition] = max(self.revision(partition), epoch)

    def revision(self, partition: int) -> int:
        """The latest revision of the lease of a partition that this node has; 0 without it."""
        return self.leases.revision(f"{PARTITION}{partition}")

    def holder(self, partition: int) -> Holding | None:
        """Who has the lease of a partition, as far as is known."""
        return self.leases.holder(f"{PARTITION}{partition}")

    def is_other(self, holder: Holding) -> bool:
        """Whether that is another process; it may have the name of this node."""
        return holder.process != self.leases.process

    @property
    def partitions(self) -> list[int]:
        """The partitions of this node."""
        return list(self._begun)

    def _about(self, key: str) -> dict[str, Any]:
        return self._shown if key.startswith(NODE) else {}

    def _show(self) -> None:
        """Prepares what others are shown, for the thread of the leases."""
        self._shown_at = time.monotonic()
        self._shown = {
            "started": self._started,
            "leaving": self._is_leaving,
            "total": self.settings.partitions,
            "terms": self._terms_digest,
            **self._node_about(),
        }

    def start(self) -> None:
        """Starts the thread of the leases."""
        self._relay.attach(asyncio.get_running_loop())
        self._show()
        self._thread.start()

    async def stop(self) -> None:
        """Ends the thread of the leases. What is still held is given back if nothing uses it."""
        await asyncio.to_thread(self._thread.stop, 0.0)

    async def join(self) -> None:
        """Takes the lease of the node. Raises `FleetRefused` if its name is in use."""
        self._thread.want([self._key])
        self._named_since = time.monotonic()
        while not self.leases.since(self._key):
            self._check_name()
            await asyncio.sleep(GATHER_S)
        log_lines.write(
            logging.INFO,
            "fleet_joined",
            fleet=self.settings.name,
            node=self.node,
            nodes=",".join(self.nodes),
        )

    def _check_name(self) -> None:
        """Raises `FleetRefused` if another process has the name of this node, and renews its lease.

        One of a process that has died would have ended by then.
        """
        holder = self.leases.holder(self._key)
        now = time.monotonic()
        if holder is None or not self.is_other(holder) or self.leases.reason is not None:
            self._named_since = now
        elif now - self._named_since > 2 * self.leases.times.ttl_s:
            raise FleetRefused(f"another process is the node {self.node}: give it another name")

    async def run(self) -> None:
        """Holds the partitions that this node should have, until it is cancelled.

        Raises `FleetRefused` if another process has taken its name, while this one was stopped.
        """
        known: list[str] = []
        while True:
            await tasks.within(CHECK_INTERVAL_S, self._has_changed.wait())
            await asyncio.sleep(GATHER_S)
            self._has_changed.clear()
            self._check_name()
            nodes = self.nodes
            if nodes != known:
                fields = {"fleet": self.settings.name, "nodes": ",".join(nodes)}
                log_lines.write(logging.INFO, "fleet_changed", **fields)
                known = nodes
            self._assign(nodes)
            if time.monotonic() > self._shown_at + self.leases.times.renewal_s:
                self._show()

    def _assign(self, nodes: list[str]) -> None:
        if self._is_leaving:
            return
        held = {
            partition: holder.node
            for partition in range(self.settings.partitions)
            if (holder := self.holder(partition)) is not None
        }
        target = assigned(self.settings.partitions, nodes, held)
        mine = {f"{PARTITION}{each}" for each, node in target.items() if node == self.node}
        self._thread.want([self._key, *mine])
        self._handover.begin(key for key in self._held_partitions() if key not in mine)

    def _held_partitions(self) -> list[str]:
        return [key for key in self.leases.held if key.startswith(PARTITION)]

    async def leave(self) -> None:
        """Hands all partitions over, and ends the lease of the node."""
        self._is_leaving = True
        self._show()
        self._thread.want([])
        await self._thread.renew_now(self._key)
        await self._handover.at_once(self._held_partitions())
        await self._thread.give_back(self._key, 0.0)
        log_lines.write(logging.INFO, "fleet_left", fleet=self.settings.name, node=self.node)

    def _settle(self, key: str) -> None:
        """Begins or ends with the devices of a partition, as its lease is now.

        It may have changed again since the event: the thread of the leases runs meanwhile.
        """
        if not key.startswith(PARTITION):
            return
        partition = int(key.removeprefix(PARTITION))
        since = self.leases.since(key)
        if since == self._begun.get(partition, 0):
            return
        if self._begun.pop(partition, 0):
            del self._epochs[partition]
            self._lost(partition)
        if since:
            self._begun[partition] = self._epochs[partition] = since
            self._gained(partition)
        self._shown_at = 0.0

    def taken(self, key: str) -> None:
        """A lease was taken."""
        self._has_changed.set()
        self._settle(key)

    def lost(self, key: str, reason: str) -> None:
        """A lease is not held any more."""
        self._has_changed.set()
        log_lines.refused(
            "lease_lost", kind="lease", fleet=self.settings.name, lease=key, reason=reason
        )
        self._settle(key)

    def changed(self) -> None:
        """Somebody else has taken or left a lease."""
        self._has_changed.set()

    def availability_changed(self, reason: str | None) -> None:
        """The bucket of leases works; or it does not, for this reason."""
        if reason is None:
            log_lines.write(logging.INFO, "leases_available", fleet=self.settings.name)
        else:
            log_lines.write(
                logging.WARNING, "leases_unavailable", fleet=self.settings.name, reason=reason
            )
