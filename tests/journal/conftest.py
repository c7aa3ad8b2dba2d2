"""A nats-server, and nodes of a log over it."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast._core import Log
from support import wire
from support.brokers import NatsServer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


class Node:
    """A memory of the log `site`, served over Modbus."""

    def __init__(self, stack: ExitStack, name: str, servers: list[str], **options: Any) -> None:
        self.memory = holdfast.Memory(coils=64, holding_registers=100)
        # Shorter than the timeout of the client, which is told what became of its write.
        options = {"write_timeout": wire.DEADLINE / 2, **options}
        self.log = Log("site", name, servers, [("plant", self.memory)], **options)
        stack.callback(self.log.stop)
        self.log.start(wire.DEADLINE)
        server = stack.enter_context(
            holdfast.Server({1: self.memory}, bind="127.0.0.1:0", access="read-write")
        )
        url = f"tcp://127.0.0.1:{server.address[1]}"
        self.address = server.address
        client = holdfast.SyncClient(url, timeout=wire.DEADLINE)
        self.client = stack.enter_context(client)

    def read(self, address: int) -> int:
        return self.client.read_holding_registers(address, 1)[0]


@pytest.fixture
def nats(tmp_path: Path) -> Iterator[NatsServer]:
    server = NatsServer(tmp_path)
    yield server
    server.kill()


@pytest.fixture
def node(nats: NatsServer) -> Iterator[Callable[..., Node]]:
    with ExitStack() as stack:

        def start(name: str, servers: list[str] | None = None, **options: Any) -> Node:
            return Node(stack, name, servers or [nats.url], **options)

        yield start
