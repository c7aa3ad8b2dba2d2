"""What tests stand on: memories, servers on a free port, connections, and servers in a process
of their own.

Nothing here leaves the loopback interface, and everything that is started is stopped.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Literal, Protocol, TypedDict

import pytest

import holdfast
import wire
from holdfast import logs
from holdfast.appliance import Appliance
from holdfast.config import load

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from pathlib import Path
    from typing import Unpack

    from holdfast.identity import Identity
    from holdfast.types import Access, Area

pytest_plugins = ("nats_bus",)

AREAS: tuple[Area, ...] = ("coils", "discrete_inputs", "holding_registers", "input_registers")


class ServerOptions(TypedDict, total=False):
    """What `holdfast.Server` takes, apart from units."""

    bind: str
    access: Access
    sources: Sequence[str]
    functions: Collection[int]
    deny: Collection[int]
    max_connections: int
    max_connections_per_source: int
    when_full: Literal["refuse", "evict"]
    idle_timeout: float
    request_timeout: float
    workers: int
    identity: Identity


class ConnectOptions(TypedDict, total=False):
    """What `wire.Connection` takes, apart from the address."""

    source: str
    receive_buffer: int
    deadline: float


SERVE_UNTIL_STDIN_ENDS = """
import json, resource, sys
import holdfast
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
memory = holdfast.Memory(
    coils=1000, discrete_inputs=1000, holding_registers=1000, input_registers=1000
)
with holdfast.Server({1: memory}, **json.loads(sys.argv[1])) as server:
    print(*server.address, flush=True)
    sys.stdin.read()
"""


def missing(what: str) -> None:
    """Skips a test on a developer's machine; in CI, where everything is installed, fails it."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"{what} is missing, and this is CI")
    pytest.skip(f"{what} is missing")


def tool(name: str) -> str:
    """The path of an external program."""
    path = shutil.which(name)
    if path is None:
        missing(f"the program {name}")
    return str(path)


def has_ipv6() -> bool:
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET6) as probe:
        probe.bind(("::1", 0))
        return True
    return False


@pytest.fixture
def ipv6() -> None:
    """Needs IPv6 on the loopback interface."""
    if not has_ipv6():
        missing("IPv6 on the loopback interface")


class Serve(Protocol):
    """Starts a server that is stopped when the test ends."""

    def __call__(
        self, units: Mapping[int, holdfast.Memory], **options: Unpack[ServerOptions]
    ) -> holdfast.Server: ...


class Connect(Protocol):
    """Opens a connection that is closed when the test ends."""

    def __call__(
        self, to: holdfast.Server | tuple[str, int], **options: Unpack[ConnectOptions]
    ) -> wire.Connection: ...


class ServerProcess:
    """A server apart: its file descriptors and its memory are not those of the test."""

    def __init__(self, **options: Unpack[ServerOptions]) -> None:
        settings = {"bind": "127.0.0.1:0", "access": "read-write"} | options
        self._process = subprocess.Popen(
            [sys.executable, "-c", SERVE_UNTIL_STDIN_ENDS, json.dumps(settings)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.pid = self._process.pid
        assert self._process.stdout is not None
        try:
            host, port = self._process.stdout.readline().split()
        except ValueError:
            self.stop()
            raise RuntimeError("the server process did not start") from None
        self.address = (host, int(port))

    def stop(self) -> None:
        try:
            self._process.communicate(timeout=wire.DEADLINE)
        finally:
            self._process.kill()
            self._process.wait()


class Process(Protocol):
    """Starts a server process that is stopped when the test ends."""

    def __call__(self, **options: Unpack[ServerOptions]) -> ServerProcess: ...


@pytest.fixture
def memory() -> holdfast.Memory:
    """Every area with the addresses 0 to 999, all zero."""
    return holdfast.Memory(
        coils=1000, discrete_inputs=1000, holding_registers=1000, input_registers=1000
    )


@pytest.fixture
def serve() -> Iterator[Serve]:
    with ExitStack() as running:

        def start(
            units: Mapping[int, holdfast.Memory], **options: Unpack[ServerOptions]
        ) -> holdfast.Server:
            settings: ServerOptions = {"bind": "127.0.0.1:0", "access": "read-write"}
            settings.update(options)
            return running.enter_context(holdfast.Server(units, **settings))

        yield start


@pytest.fixture
def server(memory: holdfast.Memory, serve: Serve) -> holdfast.Server:
    """Unit 1 is `memory`, to read and to write."""
    return serve({1: memory})


@pytest.fixture
def connect() -> Iterator[Connect]:
    with ExitStack() as opened:

        def open_connection(
            to: holdfast.Server | tuple[str, int], **options: Unpack[ConnectOptions]
        ) -> wire.Connection:
            address = to if isinstance(to, tuple) else to.address
            return opened.enter_context(wire.Connection(address, **options))

        yield open_connection


@pytest.fixture
def client(server: holdfast.Server, connect: Connect) -> wire.Connection:
    """A connection to `server`."""
    return connect(server)


@pytest.fixture
def server_process() -> Iterator[Process]:
    with ExitStack() as running:

        def start(**options: Unpack[ServerOptions]) -> ServerProcess:
            process = ServerProcess(**options)
            running.callback(process.stop)
            return process

        yield start


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    """Commands that run in a test's own process set up the log: the next finds it as it was."""
    logger = logs.LOGGER
    before = (list(logger.handlers), logger.level, logger.propagate)
    yield
    logger.handlers[:], logger.propagate = before[0], before[2]
    logger.setLevel(before[1])


class Run(Protocol):
    """Starts an appliance that is stopped when the test ends."""

    def __call__(self, text: str) -> Appliance: ...


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Runs the configuration that a text is; files it names are in `tmp_path`."""
    with ExitStack() as running:

        def start(text: str) -> Appliance:
            file = tmp_path / "appliance.yaml"
            file.write_text(text)
            return running.enter_context(Appliance(load(file)))

        yield start


def endpoint(appliance: Appliance, name: str) -> tuple[str, int]:
    """The address and port that a part of an appliance listens on."""
    [(host, port)] = [(e.host, e.port) for e in appliance.endpoints() if e.name == name]
    assert port is not None
    return host, port


def content(memory: holdfast.Memory) -> dict[Area, list[int]]:
    """All four areas of a memory whose areas start at 0 and have 1000 items."""
    ranges: list[tuple[Area, int, int]] = [(area, 0, 1000) for area in AREAS]
    return dict(zip(AREAS, memory.read_many(ranges), strict=True))


def rounds(enough: threading.Event, least: int = 1) -> Iterator[int]:
    """Counts rounds until there are enough: on a slow machine threads meet later, not never."""
    deadline = time.monotonic() + 3 * wire.DEADLINE
    for number in itertools.count():
        if number >= least and enough.is_set():
            return
        if time.monotonic() > deadline:
            raise AssertionError(f"the threads did not meet in {number} rounds")
        yield number
