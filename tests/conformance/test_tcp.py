"""Requirements of Modbus on TCP/IP that no test of a part shows."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import holdfast
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support.running import Connect

READ = bytes.fromhex("0300000001")


def test_a_client_keeps_one_connection_and_closes_it_at_the_end(server: holdfast.Server) -> None:
    host, port = server.address
    clients = [holdfast.SyncClient(f"tcp://{host}:{port}") for _ in range(2)]
    for _ in range(3):
        for client in clients:
            client.read_holding_registers(0, 1)
    names = {end.name for end in connections() if end.peer == (host, port)}

    assert server.counters()["connections"]["accepted"] == 2
    assert len(names) == 2
    assert all(own > 1023 for _, own in names)
    for client in clients:
        client.close()
    wire.until(lambda: server.counters()["connections"]["open"] == 0, "they are closed")


def test_a_server_listens_again_at_once_although_a_client_was_connected(
    memory: holdfast.Memory, connect: Connect
) -> None:
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-only") as first:
        host, port = first.address
        client = connect(first)
        client.ask(READ)
    # The server has closed the connection first, so its port is kept for a while.
    assert client.rest() == b""
    client.close()

    with holdfast.Server({1: memory}, bind=f"{host}:{port}", access="read-only") as second:
        assert connect(second).ask(READ) == bytes.fromhex("03020000")


def test_both_ends_of_a_connection_send_at_once(server: holdfast.Server) -> None:
    host, port = server.address
    with holdfast.SyncClient(f"tcp://{host}:{port}") as client:
        client.read_holding_registers(0, 1)
        ends = [end for end in connections() if (host, port) in (end.name, end.peer)]

    assert [end.sends_at_once for end in ends] == [True, True]


class End(NamedTuple):
    """One end of a TCP connection."""

    name: tuple[str, int]
    peer: tuple[str, int]
    sends_at_once: bool


def connections() -> Iterator[End]:
    """All ends in this process, those of the core too."""
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if not entry.readlink().name.startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(entry.name))) as end:
                if (end.family, end.type) == (socket.AF_INET, socket.SOCK_STREAM):
                    option = end.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
                    yield End(end.getsockname(), end.getpeername(), bool(option))
