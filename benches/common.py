"""Shared by the benchmarks: pinned processes, rotating turns, medians and ratios."""

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
# Seconds to wait for a server to start, and for a load to end.
TIMEOUT = 30
REQUEST = bytes.fromhex("123400000006010300000000")

Result: TypeAlias = dict[str, float]
Round: TypeAlias = Mapping[str, Result]


class TurnFailed(Exception):
    """A server dropped or changed a reply, or did not reply."""


def bench(*command: object) -> list[str]:
    """The command line of a load or a loop in `src`."""
    return [str(TARGET / "holdfast-benches"), *map(str, command)]


def python(script: str, *arguments: object, checkout: Path | None = None) -> list[str]:
    """The command line of a script of `benches`, here or in another checkout with its packages."""
    interpreter = checkout / ".venv" / "bin" / "python" if checkout else sys.executable
    return [str(interpreter), str((checkout or ROOT) / "benches" / script), *map(str, arguments)]


def http_load(address: str, file: Path, requests: Sequence[bytes], connections: int) -> list[str]:
    """The command line of a load with HTTP requests, which are written into files."""
    files = [file.with_suffix(f".{number}") for number in range(len(requests))]
    for each, request in zip(files, requests, strict=True):
        each.write_bytes(request)
    options = [word for each in files for word in ("--http", each)]
    return bench("load", "--address", address, *options, "--connections", connections)


def http_request(
    address: str, path: str, *, token: str | None = None, body: bytes | None = None
) -> bytes:
    """The bytes of a request: GET, or POST with a body of JSON."""
    lines = [f"{'GET' if body is None else 'POST'} {path} HTTP/1.1", f"Host: {address}"]
    if token is not None:
        lines.append(f"Authorization: Bearer {token}")
    if body is not None:
        lines += ["Content-Type: application/json", f"Content-Length: {len(body)}"]
    return "\r\n".join([*lines, "\r\n"]).encode() + (body or b"")


def pinned(core: int, *, idle: bool = False) -> Callable[[], None]:
    """Returns a function that pins a new process to a core; with `idle`, under SCHED_IDLE."""

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
        """Reads until a line `listening NAME ADDRESS`; the name is optional."""
        assert self.process.stdout is not None
        for line in iter(self.process.stdout.readline, ""):
            words = line.split()
            if words[:1] == ["listening"]:
                return " ".join(words[1:-1]), words[-1]
            if line.startswith("  ") and line[2] != " ":  # A line of `holdfast run`.
                return words[0], words[-1].rpartition("/")[2]
        self.process.kill()
        self.process.wait()
        self.log.seek(0)
        raise RuntimeError(f"{self.name} did not start: {self.log.read()[-2000:]}")

    def cpu(self) -> float:
        """Returns the processor time so far, in seconds."""
        return time.clock_gettime(~self.process.pid << 3 | 2)  # As clock_getcpuclockid(3) does.

    def stop(self) -> None:
        """Kills the process."""
        self.process.kill()
        self.process.communicate()


@contextlib.contextmanager
def started(name: str, command: Sequence[str], core: int, listeners: int = 1) -> Iterator[Server]:
    """Runs a server."""
    with tempfile.TemporaryFile("w+") as log:
        server = Server(name, command, core, listeners, log)
        try:
            yield server
        finally:
            server.stop()


@contextlib.contextmanager
def appliance(
    configuration: str,
    core: int,
    listeners: int,
    loop: str = "asyncio",
    checkout: Path | None = None,
) -> Iterator[Server]:
    """Runs `holdfast run` with a configuration in YAML; of another checkout, if one is given."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "holdfast.yaml"
        file.write_text(configuration)
        command = python("holdfast_run.py", loop, file, checkout=checkout)
        with started("holdfast", command, core, listeners) as server:
            yield server


@contextlib.contextmanager
def running(
    command: Sequence[str], core: int, *, idle: bool = False
) -> Iterator[subprocess.Popen[str]]:
    """Runs a process, and kills it at the end of the context."""
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
    """Runs a process for `seconds`, and returns the result that it prints."""
    with running(command, core) as process:
        try:
            out, error = process.communicate(timeout=seconds + TIMEOUT)
        except subprocess.TimeoutExpired:
            raise TurnFailed("the process did not end in time") from None
    if process.returncode != 0:
        raise TurnFailed(error.strip())
    result: Result = json.loads(out)
    return result


def load(command: Sequence[str], seconds: float, core: int, server: Server) -> Result:
    """Runs a load. Returns its result with the server's processor time per request."""
    before = server.cpu()
    result = outcome([*command, "--seconds", str(seconds)], seconds, core)
    if not result["requests"]:
        raise TurnFailed("nothing was answered in time")
    # `answered` includes the warm-up and late replies, which also cost processor time.
    result["server_us"] = (server.cpu() - before) / result["answered"] * 1e6
    return result


def ask(address: str, quantity: int) -> bytes:
    """Reads holding registers of unit 1 from address 0. Returns the raw reply."""
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


def child(pid: int) -> int:
    """Returns the number of the only child process, which any thread may have started."""
    threads = Path(f"/proc/{pid}/task").glob("*/children")
    [found] = [found for thread in threads for found in thread.read_text().split()]
    return int(found)


def memory(pid: int) -> dict[str, int]:
    """Returns the resident memory of a process, and its own without pages of files, in bytes."""
    found: dict[str, int] = {}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]:
        name, size, _ = line.split()
        found[name] = 1024 * int(size)
    return {"resident": found["Rss:"], "own": found["Anonymous:"] + found["Swap:"]}


def turns(names: Sequence[str], index: int) -> list[str]:
    """Returns all names in the order of this round. Each round starts with another name."""
    first = index % len(names)
    return [*names[first:], *names[:first]]


def medians(rounds: Sequence[Round], name: str, *keys: str) -> list[float]:
    """Returns the median of each figure."""
    return [median(one[name][key] for one in rounds if name in one) for key in keys]


def ratio(rounds: Sequence[Round], first: str, second: str, key: str = "rate") -> str:
    """Formats the ratio of two results within a round: median, minimum and maximum."""
    both = [one for one in rounds if first in one and second in one]
    if not both:
        return "-"
    ratios = [one[first][key] / one[second][key] for one in both]
    return f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


def parser(description: str | None, seconds: float, rounds: int) -> argparse.ArgumentParser:
    """Returns a parser with the options of all benchmarks."""
    options = argparse.ArgumentParser(description=description)
    options.set_defaults(seconds_otherwise=seconds, rounds_otherwise=rounds)
    options.add_argument("--seconds", type=float, help=f"per turn; default {seconds:g}")
    options.add_argument("--rounds", type=int, help=f"default {rounds}")
    options.add_argument("--quick", action="store_true", help="2 rounds of 0.3 s, as a smoke test")
    options.add_argument("--json", type=Path, help="file for all results")
    return options


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parses and checks the options. Adds `core` for the server and `other` for the load."""
    options = parser.parse_args()
    options.seconds = options.seconds or (0.3 if options.quick else options.seconds_otherwise)
    options.rounds = options.rounds or (2 if options.quick else options.rounds_otherwise)
    if options.seconds <= 0 or options.rounds < 1:
        parser.error("--seconds must be greater than 0, --rounds at least 1")
    # SIGTERM raises SystemExit, so that started processes are ended.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))
    cores = sorted(os.sched_getaffinity(0))
    options.core, options.other = cores[0], cores[-1]
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()};")
    print(f"{options.rounds} rounds of {options.seconds:g} s.")
    if len(cores) < 2:
        print("Only one core: server and load share it, so ratios are not meaningful.")
    sys.stdout.flush()
    return options
