"""Fixtures of all tests: memories, servers on a free port, connections, and server processes.

Everything stays on the loopback interface, and everything that was started is stopped.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

import holdfast
from holdfast.appliance import Appliance
from holdfast.appliance.services import supervision
from holdfast.config import load
from holdfast.events import log_lines
from holdfast.events.throttle import Throttle
from support import cases, wire
from support.machine import has_ipv6, missing
from support.running import (
    Connect,
    ConnectOptions,
    Process,
    Run,
    Serve,
    ServeOptions,
    ServerProcess,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path
    from typing import Unpack


pytest_plugins = ("support.nats_bus",)

COLLECTED = pytest.StashKey[list[str]]()

# Property tests draw the same cases in every run; only `make explore` draws new ones.
# There is no deadline: the time that a case takes depends on the load of the machine.
settings.register_profile(
    "holdfast",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=not cases.IS_EXPLORING,
    print_blob=cases.IS_EXPLORING,
    max_examples=cases.examples(100),
)
settings.load_profile("holdfast")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--slow",
        choices=("with", "without", "only"),
        default="with",
        help="what to do with the cases of tests/slow.txt (default: with)",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves out the slow cases, or all others."""
    which, ids = config.getoption("slow"), cases.slow_ids()
    config.stash[COLLECTED] = [item.nodeid for item in items]
    if which != "with":
        parts: dict[bool, list[pytest.Item]] = {True: [], False: []}
        for item in items:
            parts[cases.is_listed(item.nodeid, ids)].append(item)
        items[:] = parts[which == "only"]
        config.hook.pytest_deselected(items=parts[which != "only"])


@pytest.fixture
def collected(request: pytest.FixtureRequest) -> list[str]:
    """All cases, also those that this run leaves out. Skips if only a part is collected."""
    if request.config.args != request.config.getini("testpaths"):
        pytest.skip("pytest was called with a part of the tests")
    return request.config.stash[COLLECTED]


@pytest.fixture(autouse=True)
def _forget_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refusals and requests of one test do not limit how many another one logs."""
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle())
    monkeypatch.setattr(log_lines, "_REQUESTS", Throttle(burst=log_lines.MAX_REQUESTS))


@pytest.fixture(autouse=True)
def _adapters_have_their_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loaded machine could leave threads of the lowest priority without any time for minutes."""
    monkeypatch.setattr(supervision, "NICE", 0)


@pytest.fixture
def ipv6() -> None:
    """Requires IPv6 on the loopback interface."""
    if not has_ipv6():
        missing("IPv6 on the loopback interface")


@pytest.fixture
def many_files() -> Iterator[None]:
    """As many open files as the system allows."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    if hard < 2500:
        missing("a limit of 2500 open files")
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.fixture
def memory() -> holdfast.Memory:
    """A memory with the addresses 0 to 999 in every area, all zero."""
    return holdfast.Memory(
        coils=1000, discrete_inputs=1000, holding_registers=1000, input_registers=1000
    )


@pytest.fixture
def serve() -> Iterator[Serve]:
    with ExitStack() as running:

        def start(
            units: Mapping[int, holdfast.Memory], **options: Unpack[ServeOptions]
        ) -> holdfast.Server:
            settings: ServeOptions = {"bind": "127.0.0.1:0", "access": "read-write"}
            settings.update(options)
            return running.enter_context(holdfast.Server(units, **settings))

        yield start


@pytest.fixture
def server(memory: holdfast.Memory, serve: Serve) -> holdfast.Server:
    """A server with `memory` as unit 1, with read and write access."""
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

        def start(**options: Unpack[ServeOptions]) -> ServerProcess:
            process = ServerProcess(**options)
            running.callback(process.stop)
            return process

        yield start


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    """Restores the log, which commands that run in the test's process configure."""
    logger = log_lines.LOGGER
    before = (list(logger.handlers), logger.level, logger.propagate)
    yield
    logger.handlers[:], logger.propagate = before[0], before[2]
    logger.setLevel(before[1])


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Runs an appliance with a configuration text. Its files are in `tmp_path`."""
    with ExitStack() as running:

        def start(text: str) -> Appliance:
            file = tmp_path / "appliance.yaml"
            file.write_text(text)
            return running.enter_context(Appliance(load(file)))

        yield start
