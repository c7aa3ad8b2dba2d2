"""What packets that are not complete may occupy, and that it is given back."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from holdfast import raw_ingest
from support import wire
from support.config_folder import written
from support.machine import needs_proc, resident

if TYPE_CHECKING:
    from collections.abc import Iterator

COUNT = 1000
ROOM = 144 * 1024
"""The most that docs/raw-ingest.md allows for a connection."""

LONG = raw_ingest.encode("holding_registers", 0, range(65535), unit=1)
SHORT = raw_ingest.encode("holding_registers", 0, [7], unit=1)

SERVE = """
import json, sys
from pathlib import Path
from holdfast.appliance import Appliance
from holdfast.config import load
with Appliance(load(Path(sys.argv[1]))) as appliance:
    [endpoint] = appliance.endpoints()
    print(json.dumps([endpoint.host, endpoint.port]), flush=True)
    for _ in sys.stdin:
        print(json.dumps(appliance.diagnostics.stats()["listeners"]["raw"]), flush=True)
"""


class Process(NamedTuple):
    """An appliance with one listener, `raw`, in a process of its own."""

    pid: int
    address: tuple[str, int]
    pipes: subprocess.Popen[str]

    def counters(self) -> dict[str, Any]:
        assert self.pipes.stdin is not None
        assert self.pipes.stdout is not None
        print(file=self.pipes.stdin, flush=True)
        counters: dict[str, Any] = json.loads(self.pipes.stdout.readline())
        return counters

    def held(self) -> int:
        held: int = self.counters()["packets"]["held_bytes"]
        return held

    def open(self) -> int:
        opened: int = self.counters()["connections"]["open"]
        return opened


@contextlib.contextmanager
def serving(folder: Path, **settings: Any) -> Iterator[Process]:
    rule = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "areas": ["holding_registers"]}
    limits = {"max_connections": 2 * COUNT, "max_connections_per_source": None}
    listener = {"type": "raw-ingest", "bind": "127.0.0.1:0", "rules": [rule], **limits, **settings}
    memories = {"plant": {"holding_registers": 65536}}
    file = folder / "plant.yaml"
    file.write_text(written({"memories": memories, "listeners": {"raw": listener}}))
    arguments = [sys.executable, "-c", SERVE, str(file)]
    pipes = subprocess.Popen(arguments, stdin=-1, stdout=-1, text=True)
    with pipes:
        try:
            assert pipes.stdout is not None
            host, port = json.loads(pipes.stdout.readline())
            yield Process(pipes.pid, (host, port), pipes)
        finally:
            pipes.kill()


def half_sent(process: Process, opened: contextlib.ExitStack, count: int) -> list[socket.socket]:
    """Connections that have sent a long packet but for its last byte."""
    clients = []
    for _ in range(count):
        client = opened.enter_context(socket.create_connection(process.address, wire.DEADLINE))
        client.sendall(LONG[:-1])
        clients.append(client)
    wire.until(lambda: process.held() >= count * (len(LONG) - 1), "everything is read")
    return clients


@needs_proc
@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize("settings", [{}, {"compat": {"packets": "many"}}], ids=["one", "many"])
def test_the_memory_of_incomplete_packets_is_bounded_and_given_back_when_they_leave(
    tmp_path: Path, settings: dict[str, Any]
) -> None:
    with serving(tmp_path, **settings, request_timeout=600) as process:
        with contextlib.ExitStack() as opened:
            half_sent(process, opened, 10)
        wire.until(lambda: process.open() == 0, "all are gone")
        before = resident(process.pid)
        with contextlib.ExitStack() as opened:
            half_sent(process, opened, COUNT)
            assert process.held() <= COUNT * ROOM
            grown = resident(process.pid) - before
            assert COUNT * len(LONG) * 3 // 4 < grown < COUNT * (ROOM + 16 * 1024)
        wire.until(lambda: process.open() == 0, "all are gone")
        assert process.held() == 0
        assert resident(process.pid) - before < grown / 4


@needs_proc
@pytest.mark.usefixtures("many_files")
def test_the_memory_of_incomplete_packets_is_given_back_when_their_time_is_over(
    tmp_path: Path,
) -> None:
    with serving(tmp_path, request_timeout=1) as process, contextlib.ExitStack() as opened:
        clients = []
        for _ in range(100):
            client = opened.enter_context(socket.create_connection(process.address, wire.DEADLINE))
            client.sendall(LONG[:-1])
            clients.append(client)
        assert [client.recv(1) for client in clients] == [b"\x01"] * 100
        # The connections stay open until their senders leave, or 5 seconds.
        assert process.held() == 0
        assert process.counters()["packets"]["refused"]["late"] == 100


@pytest.mark.usefixtures("many_files")
def test_a_header_takes_no_memory_for_what_it_announces(tmp_path: Path) -> None:
    with serving(tmp_path, request_timeout=600) as process, contextlib.ExitStack() as opened:
        for _ in range(COUNT):
            client = opened.enter_context(socket.create_connection(process.address, wire.DEADLINE))
            client.sendall(LONG[:20])
        wire.until(lambda: process.open() == COUNT, "all are there")
        wire.until(lambda: process.held() >= 20 * COUNT, "everything is read")
        assert process.held() <= 64 * COUNT


def test_a_connection_that_waits_keeps_no_memory_of_its_packets(tmp_path: Path) -> None:
    with (
        serving(tmp_path, compat={"packets": "many"}, idle_timeout=0) as process,
        socket.create_connection(process.address, wire.DEADLINE) as client,
    ):
        client.sendall(LONG + SHORT)
        replies = b""
        while len(replies) < 2:
            replies += client.recv(2)
        assert replies == b"\0\0"
        wire.until(lambda: process.held() == 0, "it is given back")
        client.sendall(LONG + LONG[:100])
        assert client.recv(1) == b"\0"
        wire.until(lambda: 100 <= process.held() <= 2048, "only the beginning is kept")


@needs_proc
@pytest.mark.parametrize("kind", ["raw-ingest", "modbus-tcp"])
def test_the_system_keeps_a_bounded_number_of_bytes_that_nobody_has_read(
    tmp_path: Path, kind: str
) -> None:
    """A stopped process reads nothing. The system takes some bytes, and then no more."""
    own = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}
    settings = {} if kind == "raw-ingest" else {"type": kind, "rules": [own]}
    with serving(tmp_path, **settings) as process:
        client = socket.create_connection(process.address, wire.DEADLINE)
        with client:
            wire.until(lambda: process.open() == 1, "it is there")
            os.kill(process.pid, signal.SIGSTOP)
            # Its threads run on until the system has stopped them all.
            os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
            try:
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 64 * 1024)
                client.settimeout(0.2)
                taken = 0
                with contextlib.suppress(TimeoutError):
                    while taken < 8_000_000:
                        taken += client.send(bytes(64 * 1024))
            finally:
                os.kill(process.pid, signal.SIGCONT)
            # What the system of the sender keeps is in it too.
            assert taken < 1_500_000
