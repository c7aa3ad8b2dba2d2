"""Three NATS servers that form a cluster."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, TypeVar

from nats.aio.client import Client
from nats.errors import Error
from nats.js.errors import Error as JetStreamError

from support import wire
from support.brokers import NatsServer, free_port

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator
    from pathlib import Path

    from nats.js import JetStreamContext
    from nats.js.api import StreamInfo

Answer = TypeVar("Answer")

TIMEOUT_S = 1.0
"""Time for the cluster to tell of a stream. It may give no answer as long as it has no leader."""

LOOKS = 50
"""Looks at a stream over one connection."""

TRIED = "tried"
"""A stream that is made to see whether the cluster works."""


class NatsCluster:
    """The servers s0, s1 and s2. Each can end and start again with its port and store."""

    def __init__(self, folder: Path) -> None:
        routes = [f"nats://127.0.0.1:{free_port()}" for _ in range(3)]
        self.servers: dict[str, NatsServer] = {}
        try:
            for number, route in enumerate(routes):
                name = f"s{number}"
                of_server = folder / name
                of_server.mkdir()
                options = ["--server_name", name, "--cluster_name", "plant"]
                options += ["--cluster", route, "--routes", ",".join(routes)]
                self.servers[name] = NatsServer(of_server, *options)
            wire.until(
                lambda: any("new metadata leader" in each.log for each in self.servers.values()),
                "there is a leader",
            )
            wire.until(self._stores, "the leader knows all servers")
        except BaseException:
            self.kill()
            raise

    @property
    def urls(self) -> list[str]:
        return [server.url for server in self.servers.values()]

    def kill(self) -> None:
        """Kills all servers."""
        for server in self.servers.values():
            server.kill()

    def leader(self, stream: str) -> str:
        """Waits until a stream has a leader. Returns the name of that server."""
        found: list[str] = []

        def is_led(info: StreamInfo) -> bool:
            if info.cluster is not None and info.cluster.leader:
                found.append(info.cluster.leader)
            return bool(found)

        self._until(stream, is_led, f"{stream} has a leader")
        return found[-1]

    def until_whole(self, stream: str) -> None:
        """Waits until all replicas of a stream have all of it."""

        def is_whole(info: StreamInfo) -> bool:
            if info.cluster is None or not info.cluster.leader:
                return False
            replicas = info.cluster.replicas or []
            return len(replicas) == 2 and all(
                each.current and not each.offline for each in replicas
            )

        self._until(stream, is_whole, f"{stream} has all replicas")

    def _stores(self) -> bool:
        """Whether a stream can have a replica on each server."""

        async def stores(jetstream: JetStreamContext) -> bool:
            await jetstream.add_stream(name=TRIED, subjects=[TRIED], num_replicas=3)
            return await jetstream.delete_stream(TRIED)

        return bool(asyncio.run(self._asked(stores)))

    def _until(self, stream: str, condition: Callable[[StreamInfo], bool], what: str) -> None:
        async def is_met(jetstream: JetStreamContext) -> bool:
            for _ in range(LOOKS):
                if condition(await jetstream.stream_info(stream)):
                    return True
                await asyncio.sleep(0.02)
            return False

        # The server that is asked may end, or have no answer.
        wire.until(lambda: asyncio.run(self._asked(is_met)), what)

    async def _asked(
        self, request: Callable[[JetStreamContext], Coroutine[Any, Any, Answer]]
    ) -> Answer | None:
        async def ignore(_: Exception) -> None:
            pass

        client = Client()
        try:
            await client.connect(list(self.urls), allow_reconnect=False, error_cb=ignore)
            return await request(client.jetstream(timeout=TIMEOUT_S))
        except (Error, JetStreamError, OSError):
            return None
        finally:
            with contextlib.suppress(Exception):
                await client.close()


def running(folder: Path) -> Iterator[NatsCluster]:
    """A cluster that ends with its test, for fixtures."""
    cluster = NatsCluster(folder)
    try:
        yield cluster
    finally:
        cluster.kill()
