"""Writers and readers on real sockets at once: a read sees all of a write or none of it.

The servers have several workers, so that requests of different connections really meet.
"""

from __future__ import annotations

import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

import pytest

import holdfast
from support import wire
from support.wire import rounds

if TYPE_CHECKING:
    from collections.abc import Callable

    from support.running import Serve

WORKERS = 4
REGISTERS = 123
COILS = 1968
BATCH = 50


@pytest.fixture
def memory() -> holdfast.Memory:
    return holdfast.Memory(coils=2000, holding_registers=1000)


@pytest.fixture
def server(memory: holdfast.Memory, serve: Serve) -> holdfast.Server:
    return serve({1: memory}, workers=WORKERS)


def write_registers(value: int) -> bytes:
    head = struct.pack(">BHHB", 16, 0, REGISTERS, REGISTERS * 2)
    return head + struct.pack(">H", value) * REGISTERS


def write_coils(bit: int) -> bytes:
    data = bytes([0xFF if bit else 0x00]) * (COILS // 8)
    return struct.pack(">BHHB", 15, 0, COILS, COILS // 8) + data


def at_once(*tasks: Callable[[], object]) -> list[object]:
    """Runs tasks on a thread each, started together; what they returned."""
    gate = threading.Barrier(len(tasks))

    def started(task: Callable[[], object]) -> object:
        gate.wait(wire.DEADLINE)
        return task()

    with ThreadPoolExecutor(len(tasks)) as threads:
        return [future.result() for future in [threads.submit(started, task) for task in tasks]]


class Meeting:
    """Notes when each of some readers has seen the values change often enough."""

    CHANGES = 20

    def __init__(self, readers: int) -> None:
        self.enough = threading.Event()
        self.over = threading.Event()
        self._lock = threading.Lock()
        self._to_come = readers

    def read(self, server: holdfast.Server, request: bytes) -> set[bytes]:
        """Reads until all is over; the different replies."""
        seen: set[bytes] = set()
        changes, last = 0, b""
        with wire.Connection(server.address) as client:
            while not self.over.is_set():
                for reply in client.ask_many([request] * BATCH):
                    assert reply[0] == request[0]
                    seen.add(reply)
                    if reply != last:
                        changes, last = changes + 1, reply
                        if changes == self.CHANGES:
                            self._satisfied()
        return seen

    def _satisfied(self) -> None:
        with self._lock:
            self._to_come -= 1
            if self._to_come == 0:
                self.enough.set()


def race(server: holdfast.Server, writes: list[list[bytes]], read: bytes) -> set[bytes]:
    """One writer for each list of requests, against two readers; what the readers saw.

    The writers send their list over and over until the readers have seen enough.
    """
    meeting = Meeting(readers=2)
    writing = threading.Semaphore(len(writes) - 1)

    def write(requests: list[bytes]) -> None:
        try:
            with wire.Connection(server.address) as client:
                for _ in rounds(meeting.enough, least=2):
                    for start in range(0, len(requests), BATCH):
                        replies = client.ask_many(requests[start : start + BATCH])
                        assert all(reply[0] < 0x80 for reply in replies)
        finally:
            if not writing.acquire(blocking=False):
                meeting.over.set()

    reader = partial(meeting.read, server, read)
    first, second = at_once(*[partial(write, its) for its in writes], reader, reader)[-2:]
    assert isinstance(first, set)
    assert isinstance(second, set)
    return first | second


def test_no_reader_sees_a_part_of_a_write_of_registers(server: holdfast.Server) -> None:
    writes = [[write_registers(base + turn) for turn in range(10_000)] for base in (1, 20_001)]

    seen = race(server, writes, struct.pack(">BHH", 3, 0, REGISTERS))

    assert [reply for reply in seen if reply[2:] != reply[2:4] * REGISTERS] == []


def test_no_reader_sees_a_part_of_a_write_of_coils(server: holdfast.Server) -> None:
    writes = [[write_coils((turn + first) % 2) for turn in range(10_000)] for first in (0, 1)]

    seen = race(server, writes, struct.pack(">BHH", 1, 0, COILS))

    assert {reply[2:] for reply in seen} == {bytes(246), b"\xff" * 246}


def test_no_reader_sees_a_part_of_a_write_that_shares_bytes_with_its_neighbours(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    def write(start: int, count: int, bit: int) -> bytes:
        data = ((1 << count) - 1 if bit else 0).to_bytes((count + 7) // 8, "little")
        return struct.pack(">BHHB", 15, start, count, len(data)) + data

    halves = [(0, 983), (983, 985)]
    writes = [[write(*half, (turn + 1) % 2) for turn in range(10_000)] for half in halves]

    for reply in race(server, writes, struct.pack(">BHH", 1, 0, COILS)):
        bits = int.from_bytes(reply[2:], "little")
        assert bits & (1 << 983) - 1 in (0, (1 << 983) - 1)
        assert bits >> 983 in (0, (1 << 985) - 1)
    assert memory.read("coils", 0, COILS) == [0] * COILS


def test_python_writes_are_seen_whole_by_modbus_readers(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    meeting = Meeting(readers=1)

    def write() -> None:
        try:
            for turn in rounds(meeting.enough, least=1000):
                value = turn & 0xFFFF
                memory.write_many(
                    [("holding_registers", start, [value] * 41) for start in (0, 41, 82)]
                )
        finally:
            meeting.over.set()

    read = struct.pack(">BHH", 3, 0, REGISTERS)
    _, seen = at_once(write, partial(meeting.read, server, read))

    assert isinstance(seen, set)
    assert [reply for reply in seen if reply[2:] != reply[2:4] * REGISTERS] == []


def test_mask_writes_of_many_clients_lose_no_bit(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    def setter(bit: int) -> None:
        mask = 1 << bit
        requests = [
            struct.pack(">BHHH", 22, register, 0xFFFF ^ mask, mask) for register in range(1000)
        ]
        with wire.Connection(server.address) as client:
            for start in range(0, 1000, BATCH):
                part = requests[start : start + BATCH]
                assert client.ask_many(part) == part

    at_once(*[partial(setter, bit) for bit in range(8)])

    assert memory.read("holding_registers", 0, 1000) == [0xFF] * 1000


def test_mask_writes_of_one_register_lose_no_bit(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    def toggler(bit: int) -> None:
        mask = 1 << bit
        put = struct.pack(">BHHH", 22, 0, 0xFFFF ^ mask, mask)
        clear = struct.pack(">BHHH", 22, 0, 0xFFFF ^ mask, 0)
        look = struct.pack(">BHH", 3, 0, 1)
        with wire.Connection(server.address) as client:
            for _ in range(200):
                replies = client.ask_many([put, look, clear, look] * 10)
                for place, wanted in ((1, mask), (3, 0)):
                    for reply in replies[place::4]:
                        assert int.from_bytes(reply[2:], "big") & mask == wanted
            client.ask(put)

    at_once(*[partial(toggler, bit) for bit in range(8)])

    assert memory.read("holding_registers", 0, 1) == [0xFF]


def test_a_read_write_reads_what_it_wrote_whoever_else_writes(server: holdfast.Server) -> None:
    def exchange(base: int) -> int:
        exchanged = 0
        with wire.Connection(server.address) as client:
            for start in range(base, base + 3000, BATCH):
                requests = [
                    struct.pack(">BHHHHB", 23, 0, 121, 0, 121, 242) + struct.pack(">H", value) * 121
                    for value in range(start, start + BATCH)
                ]
                for request, reply in zip(requests, client.ask_many(requests), strict=True):
                    assert reply == b"\x17\xf2" + request[10:]
                    exchanged += 1
        return exchanged

    assert at_once(*[partial(exchange, base) for base in (0, 10000, 20000, 30000)]) == [3000] * 4


def test_a_read_write_of_two_halves_never_mixes_two_writers(server: holdfast.Server) -> None:
    """Each client writes one half and reads both: the other half is whole, whoever wrote it."""

    def exchange(half: int, base: int) -> None:
        with wire.Connection(server.address) as client:
            for start in range(base, base + 3000, BATCH):
                requests = [
                    struct.pack(">BHHHHB", 23, 0, 120, half * 60, 60, 120)
                    + struct.pack(">H", value) * 60
                    for value in range(start, start + BATCH)
                ]
                for request, reply in zip(requests, client.ask_many(requests), strict=True):
                    halves = reply[2:122], reply[122:242]
                    assert halves[half] == request[10:]
                    assert halves[1 - half] == halves[1 - half][:2] * 60

    at_once(*[partial(exchange, half, base) for half, base in ((0, 0), (1, 20000))])
