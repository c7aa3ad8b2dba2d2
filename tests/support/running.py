"""Servers, appliances and connections for the duration of a test."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Protocol, TypedDict

import holdfast
from holdfast.server import ServerOptions
from holdfast.types import AREAS
from support import wire

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from typing import Unpack

    from holdfast.appliance import Appliance
    from holdfast.server import Identity
    from holdfast.types import Access, Area


class ServeOptions(ServerOptions, total=False):
    """The arguments of `holdfast.Server`, except units."""

    bind: str
    access: Access
    sources: Sequence[str]
    functions: Collection[int]
    deny: Collection[int]
    workers: int
    identity: Identity


class ConnectOptions(TypedDict, total=False):
    """The options of `wire.Connection`, except the address."""

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


class Serve(Protocol):
    """Starts a server that is stopped when the test ends."""

    def __call__(
        self, units: Mapping[int, holdfast.Memory], **options: Unpack[ServeOptions]
    ) -> holdfast.Server: ...


class Connect(Protocol):
    """Opens a connection that is closed when the test ends."""

    def __call__(
        self, to: holdfast.Server | tuple[str, int], **options: Unpack[ConnectOptions]
    ) -> wire.Connection: ...


class ServerProcess:
    """A server in its own process, with its own file descriptors and memory."""

    def __init__(self, **options: Unpack[ServeOptions]) -> None:
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

    @contextlib.contextmanager
    def frozen(self) -> Iterator[None]:
        """Stops the process meanwhile. What is sent to it arrives, and waits."""
        os.kill(self.pid, signal.SIGSTOP)
        # Its threads run on until the system has stopped them all.
        os.waitid(os.P_PID, self.pid, os.WSTOPPED | os.WNOWAIT)
        try:
            yield
        finally:
            os.kill(self.pid, signal.SIGCONT)

    def stop(self) -> None:
        try:
            self._process.communicate(timeout=wire.DEADLINE)
        finally:
            self._process.kill()
            self._process.wait()


class Process(Protocol):
    """Starts a server process that is stopped when the test ends."""

    def __call__(self, **options: Unpack[ServeOptions]) -> ServerProcess: ...


class Run(Protocol):
    """Starts an appliance that is stopped when the test ends."""

    def __call__(self, text: str) -> Appliance: ...


def endpoint(appliance: Appliance, name: str) -> tuple[str, int]:
    """Returns the address and port on which a part of an appliance listens."""
    [(host, port)] = [(e.host, e.port) for e in appliance.endpoints() if e.name == name]
    assert port is not None
    return host, port


def content(memory: holdfast.Memory) -> dict[Area, list[int]]:
    """Returns all four areas of a memory whose areas start at 0 and have 1000 items."""
    ranges: list[tuple[Area, int, int]] = [(area, 0, 1000) for area in AREAS]
    return dict(zip(AREAS, memory.read_many(ranges), strict=True))


def log_events(appliance: Appliance) -> None:
    """Has an appliance log the events of its listeners that have occurred, up to a hundred."""
    for _ in range(100):
        appliance.log_events(0)
