"""What the benchmarks share: processes that are pinned, turns that go round, and ratios."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import IO, TypeAlias

ROOT = Path(__file__).parent.parent
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
# Seconds: how long a server may take to start, and a load to end after its time.
TIMEOUT = 30
REQUEST = bytes.fromhex("123400000006010300000000")

Result: TypeAlias = dict[str, float]
Round: TypeAlias = Mapping[str, Result]


class TurnFailed(Exception):
    """A server dropped or changed a reply, or was silent."""


def bench(*command: object) -> list[str]:
    """One of the loads and loops in `src`."""
    return [str(TARGET / "holdfast-benches"), *map(str, command)]


def python(script: str, *arguments: object) -> list[str]:
    """One of the servers beside this file."""
    return [sys.executable, str(Path(__file__).parent / script), *map(str, arguments)]


def pinned(core: int, *, idle: bool = False) -> Callable[[], None]:
    """What makes a new process stay on a core; if `idle`, it runs when nobody else wants to."""

    def prepare() -> None:
        os.sched_setaffinity(0, {core})
        if idle:
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))

    return prepare


class Server:
    """A server in a process of its own, pinned to one core."""

    def __init__(
        self, name: str, command: Sequence[str], core: int, listeners: int, log: IO[str]
    ) -> None:
        self.name = name
        self.log = log
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            text=True,
            preexec_fn=pinned(core),
        )
        watchdog = threading.Timer(TIMEOUT, self.process.kill)
        watchdog.start()
        self.addresses = dict(self._listening() for _ in range(listeners))
        watchdog.cancel()
        self.address = next(iter(self.addresses.values()))

    def _listening(self) -> tuple[str, str]:
        """The name and the address of `listening NAME ADDRESS`; the name may be left out."""
        assert self.process.stdout is not None
        words = self.process.stdout.readline().split()
        if words[:1] != ["listening"]:
            self.process.kill()
            self.process.wait()
            self.log.seek(0)
            raise RuntimeError(f"{self.name} did not start: {self.log.read()[-2000:]}")
        return " ".join(words[1:-1]), words[-1]

    def cpu(self) -> float:
        """Seconds of processor time so far."""
        return time.clock_gettime(~self.process.pid << 3 | 2)  # As clock_getcpuclockid(3) does.

    def stop(self) -> None:
        """Ends the process, whatever it does."""
        self.process.kill()
        self.process.communicate()


@contextlib.contextmanager
def started(name: str, command: Sequence[str], core: int, listeners: int = 1) -> Iterator[Server]:
    """A server."""
    with tempfile.TemporaryFile("w+") as log:
        server = Server(name, command, core, listeners, log)
        try:
            yield server
        finally:
            server.stop()


@contextlib.contextmanager
def appliance(configuration: str, core: int, listeners: int) -> Iterator[Server]:
    """Holdfast with a configuration, which is YAML."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "holdfast.yaml"
        file.write_text(configuration)
        command = python("holdfast_appliance.py", file)
        with started("holdfast", command, core, listeners) as server:
            yield server


@contextlib.contextmanager
def running(
    command: Sequence[str], core: int, *, idle: bool = False
) -> Iterator[subprocess.Popen[str]]:
    """A process that is killed in the end, if it did not end before."""
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=pinned(core, idle=idle),
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def outcome(command: Sequence[str], seconds: float, core: int) -> Result:
    """What a process prints that runs for some seconds."""
    with running(command, core) as process:
        try:
            out, error = process.communicate(timeout=seconds + TIMEOUT)
        except subprocess.TimeoutExpired:
            raise TurnFailed("it did not end") from None
    if process.returncode != 0:
        raise TurnFailed(error.strip())
    result: Result = json.loads(out)
    return result


def load(command: Sequence[str], seconds: float, core: int, server: Server) -> Result:
    """One turn: what the load says, and the server's processor time for each request."""
    before = server.cpu()
    result = outcome([*command, "--seconds", str(seconds)], seconds, core)
    if not result["requests"]:
        raise TurnFailed("nothing was answered in time")
    # Not only what counts: the server works for the warm-up and the last replies too.
    result["server_us"] = (server.cpu() - before) / result["answered"] * 1e6
    return result


def ask(address: str, quantity: int) -> bytes:
    """The reply to one read of holding registers, from address 0 of unit 1."""
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as connection:
        connection.sendall(REQUEST[:-2] + quantity.to_bytes(2, "big"))
        reply = b""
        while len(reply) < 9 + 2 * quantity:
            received = connection.recv(300)
            if not received:
                raise RuntimeError(f"{address} closed the connection after {reply.hex()}")
            reply += received
        return reply


def turns(names: Sequence[str], index: int) -> list[str]:
    """All names, in the order of this round: each begins with another one."""
    first = index % len(names)
    return [*names[first:], *names[:first]]


def medians(rounds: Sequence[Round], name: str, *keys: str) -> list[float]:
    """The median of each figure."""
    return [median(one[name][key] for one in rounds if name in one) for key in keys]


def ratio(rounds: Sequence[Round], first: str, second: str, key: str = "rate") -> str:
    """The ratio within a round: the median, the least and the most."""
    both = [one for one in rounds if first in one and second in one]
    if not both:
        return "-"
    ratios = [one[first][key] / one[second][key] for one in both]
    return f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


def parser(description: str | None, seconds: float, rounds: int) -> argparse.ArgumentParser:
    """The options that all benchmarks have."""
    options = argparse.ArgumentParser(description=description)
    options.set_defaults(seconds_otherwise=seconds, rounds_otherwise=rounds)
    options.add_argument("--seconds", type=float, help=f"of each turn; {seconds:g} if not said")
    options.add_argument("--rounds", type=int, help=f"{rounds} if not said")
    options.add_argument("--quick", action="store_true", help="2 rounds of 0.3 s: does it work?")
    options.add_argument("--json", type=Path, help="where to write all results")
    return options


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The options, checked; the cores, of which `core` is the server's and `other` the load's."""
    options = parser.parse_args()
    options.seconds = options.seconds or (0.3 if options.quick else options.seconds_otherwise)
    options.rounds = options.rounds or (2 if options.quick else options.rounds_otherwise)
    if options.seconds <= 0 or options.rounds < 1:
        parser.error("more than 0 seconds, 1 round or more")
    # The processes that were started end with this one, also then.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))
    cores = sorted(os.sched_getaffinity(0))
    options.core, options.other = cores[0], cores[-1]
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()};")
    print(f"{options.rounds} rounds of {options.seconds:g} s.")
    if len(cores) < 2:
        print("Only one core: server and load share it, so ratios say little.")
    sys.stdout.flush()
    return options
