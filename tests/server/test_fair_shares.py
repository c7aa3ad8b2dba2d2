"""Sources share a server: one that sends more than its share waits only while others do.

The server is stopped while requests arrive, so that all of them wait for it at the same time. Every
request of the source that floods writes how many its connection has sent; a request of the other
source reads how many of them were answered before it.
"""

from __future__ import annotations

import fcntl
import struct
import termios
from typing import TYPE_CHECKING

import pytest

from support import wire
from support.machine import needs_127_0_0_2

if TYPE_CHECKING:
    from support.running import Connect, Process

CONNECTIONS = 64

READ_ALL = bytes.fromhex("03 0000 0040")


def has_arrived(client: wire.Connection) -> bool:
    """Whether the system of the server has all that was sent."""
    [queued] = struct.unpack("i", fcntl.ioctl(client.socket, termios.TIOCOUTQ, bytes(4)))
    return bool(queued == 0)


def write(address: int, number: int) -> bytes:
    return b"\x06" + address.to_bytes(2, "big") + number.to_bytes(2, "big")


@needs_127_0_0_2
@pytest.mark.parametrize(("in_flight", "share"), [(1, 16), (16, 256), (100, 1024)])
def test_a_request_waits_for_one_share_of_each_other_source(
    in_flight: int, share: int, server_process: Process, connect: Connect
) -> None:
    server = server_process(sources=["127.0.0.0/8"])
    flood = [connect(server.address, source="127.0.0.1") for _ in range(CONNECTIONS)]
    other = connect(server.address, source="127.0.0.2")
    for each in (*flood, other):
        each.ask(READ_ALL)
    with server.frozen():
        for address, each in enumerate(flood):
            each.send(wire.frames(write(address, number + 1) for number in range(in_flight)))
        other.send(wire.frame(READ_ALL))
        wire.until(lambda: all(map(has_arrived, (*flood, other))), "all has arrived")
    counts = other.receive().pdu[2:]
    answered = sum(counts[1::2]) + 256 * sum(counts[::2])
    assert answered <= share
    for address, each in enumerate(flood):
        assert [each.receive().pdu for _ in range(in_flight)] == [
            write(address, number + 1) for number in range(in_flight)
        ]
