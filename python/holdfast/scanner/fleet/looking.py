"""Looks at a fleet from outside: its nodes are in the bucket of leases."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
from nats.errors import Error, NoRespondersError
from nats.js.errors import NotFoundError

from holdfast.leases import LEASE_TIMES, Holding, LeaseBucket
from holdfast.scanner.fleet.exchange import subject
from holdfast.scanner.fleet.fleet import NODE, PARTITION, leases_of
from holdfast.scanner.receiving import SafeClient, TlsClient

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from holdfast.leases import Entry
    from holdfast.scanner.broker import Servers

CONNECTING = 5
"""Seconds to connect, and to wait for answers."""

LOOKED = 0.05
"""Seconds between two looks at a node that leaves."""

LEAVING = 30.0
"""Seconds in which a node must hand its devices over."""


class FleetUnavailable(Exception):
    """NATS or the fleet can't be reached, or a node does not do what it was asked."""


@dataclass(frozen=True)
class Seen:
    """A fleet at one moment."""

    fleet: str
    nodes: dict[str, Holding]
    partitions: dict[str, str]
    """The node of each partition that has one."""
    total: int

    def shown(self, before: Seen, seconds: float) -> dict[str, Any]:
        """What programs are shown; rates since an earlier look."""
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
                    "scans_per_second": round(max(scans, 0) / seconds, 1),
                    "missed": about.get("missed", 0),
                    "lost": about.get("lost", 0),
                    "version": about.get("version", ""),
                }
            )
        return {
            "fleet": self.fleet,
            "partitions": self.total,
            "free_partitions": self.total - len(self.partitions),
            "nodes": nodes,
        }


class Looker:
    """A connection that reads the bucket of leases."""

    def __init__(self, fleet: str, servers: Servers) -> None:
        self._fleet = fleet
        self._servers = servers
        self._client = TlsClient() if servers.secure else SafeClient()
        self._seen: dict[str, Entry] = {}
        self._is_read = asyncio.Event()

    async def __aenter__(self) -> Self:
        async def ignore(_: Exception) -> None:
            pass

        try:
            await self._client.connect(
                **self._servers.options(),
                name="holdfast fleet",
                connect_timeout=CONNECTING,
                allow_reconnect=False,
                error_cb=ignore,
            )
            self._bucket = LeaseBucket(self._client, leases_of(self._fleet))
            await self._bucket.follow(self._saw, self._is_read.set)
        except NotFoundError:
            await self._client.close()
            raise FleetUnavailable(f"there is no fleet {self._fleet} yet") from None
        except (Error, OSError) as error:
            with contextlib.suppress(Exception):
                await self._client.close()
            reason = str(error) or type(error).__name__
            raise FleetUnavailable(f"can't look at the fleet {self._fleet}: {reason}") from None
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with contextlib.suppress(Exception):
            await self._client.close()

    def _saw(self, key: str, entry: Entry) -> None:
        before = self._seen.get(key)
        if before is None or entry.revision > before.revision:
            self._seen[key] = entry

    async def look(self) -> Seen:
        """Returns what is known now."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CONNECTING):
                await self._is_read.wait()
        now = time.monotonic()
        live = {
            key: entry.holding
            for key, entry in self._seen.items()
            if entry.is_live(now, LEASE_TIMES) and entry.holding is not None
        }
        nodes = {key.removeprefix(NODE): each for key, each in live.items() if key.startswith(NODE)}
        totals = [each.about.get("total", 0) for each in nodes.values()]
        return Seen(
            self._fleet,
            nodes,
            {key: each.node for key, each in live.items() if key.startswith(PARTITION)},
            max(totals, default=0),
        )

    async def drain(self, node: str, prefix: str) -> None:
        """Has a node leave. Raises `FleetUnavailable` if it does not."""
        where = subject(prefix, node, "drain")
        try:
            answer = await self._client.request(where, b"", timeout=CONNECTING)
            if not msgspec.json.decode(answer.data, type=dict[str, Any]).get("success"):
                raise FleetUnavailable(f"node {node} does not leave")
        except NoRespondersError:
            raise FleetUnavailable(f"there is no node {node} at {prefix}.fleet") from None
        except (Error, OSError, msgspec.DecodeError) as error:
            reason = str(error) or type(error).__name__
            raise FleetUnavailable(f"node {node} does not answer: {reason}") from None
        end = time.monotonic() + LEAVING
        while node in (await self.look()).nodes:
            await asyncio.sleep(LOOKED)
            if time.monotonic() > end:
                raise FleetUnavailable(f"node {node} has not left within {LEAVING:g} s")
