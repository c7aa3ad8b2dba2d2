"""Looks at a fleet from outside: its nodes are in the bucket of leases."""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nats.errors import Error, NoRespondersError
from nats.errors import TimeoutError as NoAnswer
from nats.js.errors import NotFoundError

from holdfast.net.nats.connection import FIRST_ANSWER_TIMEOUT_S, connected_once, nats_reason
from holdfast.replication.leases.bucket import Holding, LeaseBucket
from holdfast.replication.leases.times import LEASE_TIMES
from holdfast.scanner.fleet.partition_leases import NODE, PARTITION, leases_of
from holdfast.scanner.fleet.questions import ask, subject
from holdfast.scanner.messages.types import Answer

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from holdfast.net.nats.connection import Servers
    from holdfast.replication.leases.bucket import Entry

CHECK_INTERVAL_S = 0.05
"""Time between two looks at a node that leaves."""

LEAVE_TIMEOUT_S = 30.0
"""Time in which a node must hand its devices over."""


class FleetUnavailable(Exception):
    """NATS or the fleet can't be reached, or a node does not do what it was asked."""


@dataclass(frozen=True)
class FleetSnapshot:
    """A fleet at one moment."""

    fleet: str
    nodes: dict[str, Holding]
    partitions: dict[str, str]
    """The node of each partition that has one."""
    partition_count: int

    def to_json(self, before: FleetSnapshot, seconds: float) -> dict[str, Any]:
        """The fleet for JSON, with the rates since `before`, `seconds` earlier."""
        nodes = []
        for name, holding in sorted(self.nodes.items()):
            about = holding.about
            was = before.nodes.get(name)
            scans = about.get("scans", 0) - (0 if was is None else was.about.get("scans", 0))
            nodes.append(
                {
                    "node": name,
                    "state": "leaving" if about.get("leaving") else "running",
                    "started": about.get("started", 0),
                    "partitions": sum(node == name for node in self.partitions.values()),
                    "devices": about.get("devices", 0),
                    "tags": about.get("tags", 0),
                    "refused": about.get("refused", 0),
                    "scans_per_second": round(max(scans, 0) / seconds, 1),
                    "missed": about.get("missed", 0),
                    "lost": about.get("lost", 0),
                    "version": about.get("version", ""),
                }
            )
        return {
            "fleet": self.fleet,
            "partitions": self.partition_count,
            "free_partitions": self.partition_count - len(self.partitions),
            "nodes": nodes,
        }


class FleetObserver:
    """A connection that reads the bucket of leases."""

    def __init__(self, fleet: str, servers: Servers) -> None:
        self._fleet = fleet
        self._servers = servers
        self._seen: dict[str, Entry] = {}
        self._exit_stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as exit_stack:
            connecting = connected_once(self._servers, "holdfast fleet")
            began = time.monotonic()
            self._client = await exit_stack.enter_async_context(connecting)
            left = began + FIRST_ANSWER_TIMEOUT_S - time.monotonic()
            bucket, is_read = LeaseBucket(self._client, leases_of(self._fleet)), asyncio.Event()
            try:
                async with asyncio.timeout(max(left, 0.0)):
                    await bucket.follow(self._saw, is_read.set)
                    await is_read.wait()
            except NotFoundError:
                raise FleetUnavailable(f"there is no fleet {self._fleet} yet") from None
            except TimeoutError:
                raise FleetUnavailable(f"{self._where} does not answer") from None
            except (Error, OSError) as error:
                raise FleetUnavailable(f"{self._where}: {nats_reason(error)}") from None
            self._exit_stack = exit_stack.pop_all()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self._exit_stack.aclose()

    @property
    def _where(self) -> str:
        return f"JetStream of NATS at {self._servers.shown}"

    def _saw(self, key: str, entry: Entry) -> None:
        before = self._seen.get(key)
        if before is None or entry.revision > before.revision:
            self._seen[key] = entry

    async def look(self) -> FleetSnapshot:
        """Returns what is known now. Raises `FleetUnavailable`."""
        if not self._client.is_connected:
            where = f"NATS at {self._servers.shown}"
            raise FleetUnavailable(f"the connection to {where} was lost")
        now = time.monotonic()
        live = {
            key: entry.holding
            for key, entry in self._seen.items()
            if entry.is_live(now, LEASE_TIMES) and entry.holding is not None
        }
        nodes = {key.removeprefix(NODE): each for key, each in live.items() if key.startswith(NODE)}
        totals = [each.about.get("total", 0) for each in nodes.values()]
        return FleetSnapshot(
            self._fleet,
            nodes,
            {key: each.node for key, each in live.items() if key.startswith(PARTITION)},
            max(totals, default=0),
        )

    async def drain(self, node: str, prefix: str) -> None:
        """Has a node leave. Raises `FleetUnavailable` if it does not."""
        is_known = node in (await self.look()).nodes
        try:
            where = subject(prefix, node, "drain")
            answer = await ask(self._client, where, b"", Answer, FIRST_ANSWER_TIMEOUT_S)
        except (Error, OSError) as error:
            # A stream that records the subject is a responder, also if there is no such node.
            if isinstance(error, NoRespondersError if is_known else (NoRespondersError, NoAnswer)):
                flaw = f"there is no live node {node} at {prefix}.fleet"
            else:
                flaw = f"node {node} does not answer: {nats_reason(error)}"
            raise FleetUnavailable(flaw) from None
        if not answer.success:
            raise FleetUnavailable(f"node {node} does not leave: {answer.error}")
        end = time.monotonic() + LEAVE_TIMEOUT_S
        while node in (await self.look()).nodes:
            await asyncio.sleep(CHECK_INTERVAL_S)
            if time.monotonic() > end:
                raise FleetUnavailable(f"node {node} has not left within {LEAVE_TIMEOUT_S:g} s")
