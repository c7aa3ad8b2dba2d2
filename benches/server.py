"""Measures the server against pymodbus's and against a bare loop, in turn, on one machine.

The server that is measured has one core, the load the other. All servers run all the time; only one
is loaded at once, and the turns go round, so that a machine whose speed drifts treats all alike.
What is compared is the ratio within one round; what is told is the median of all rounds. A server
that loses or changes a reply has no figures in that scenario: it is told why, and not asked again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import TypeAlias

ROOT = Path(__file__).parent.parent
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
FLOOD = (2, 3000)
SCENARIOS = [(connections, in_flight) for connections in (1, 64) for in_flight in (1, 16)]
REQUEST = bytes.fromhex("123400000006010300000000")
TICKS = os.sysconf("SC_CLK_TCK")
# Seconds: how long a server may take to start, and a load to end after its time.
PATIENCE = 30

Result: TypeAlias = dict[str, float]


class TurnFailed(Exception):
    """A server dropped or changed a reply, or was silent."""


@dataclass
class Scenario:
    """What was measured with one number of connections and of requests in flight on each."""

    connections: int
    in_flight: int
    rounds: list[dict[str, Result]] = field(default_factory=list)
    failures: dict[str, str] = field(default_factory=dict)


class Server:
    """A server in a process of its own, pinned to one core."""

    def __init__(self, name: str, command: list[str], core: int) -> None:
        self.name = name
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
        )
        assert self.process.stdout is not None
        started, _, _ = select.select([self.process.stdout], [], [], PATIENCE)
        line = self.process.stdout.readline() if started else ""
        word, _, self.address = line.strip().partition(" ")
        if word != "listening":
            self.stop()
            raise RuntimeError(f"{name} did not start")

    def cpu(self) -> float:
        """Seconds of processor time so far."""
        stat = Path(f"/proc/{self.process.pid}/stat").read_text()
        user, system = stat.rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / TICKS

    def stop(self) -> None:
        """Ends the process, whatever it does."""
        self.process.kill()
        self.process.communicate()


def main() -> None:
    """Prints a table for each scenario, and writes all results where `--json` says."""
    options = arguments()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))
    cores = sorted(os.sched_getaffinity(0))
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()};")
    print(f"{options.rounds} rounds of {options.seconds} s, {options.quantity} registers a read.")
    if len(cores) < 2:
        print("Only one core: server and load share it, so ratios say little.")
    with contextlib.ExitStack() as stack:
        servers = start_servers(options, cores[0], stack)
        scenarios = []
        for connections, in_flight in SCENARIOS:
            scenarios.append(measure(servers, connections, in_flight, options, cores[-1]))
            show(scenarios[-1], [server.name for server in servers])
        beside = {} if options.null else beside_a_flood(servers[0], options, cores[-1])
    show_flood(beside)
    if options.json:
        results = {
            "scenarios": [asdict(scenario) for scenario in scenarios],
            "beside_a_flood": beside,
        }
        options.json.write_text(json.dumps(results, indent=1))
    if any({"holdfast", "bare"} & scenario.failures.keys() for scenario in scenarios):
        sys.exit("holdfast or the bare loop failed")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, help="of load in each turn; 2 if not said")
    parser.add_argument("--rounds", type=int, help="7 if not said")
    parser.add_argument("--quick", action="store_true", help="2 rounds of 0.3 s: does it work?")
    parser.add_argument("--null", action="store_true", help="the bare loop against itself")
    parser.add_argument("--quantity", type=int, default=10, help="registers a read, 1 to 125")
    parser.add_argument("--json", type=Path, help="where to write all results")
    options = parser.parse_args()
    options.seconds = options.seconds or (0.3 if options.quick else 2.0)
    options.rounds = options.rounds or (2 if options.quick else 7)
    if options.seconds <= 0 or options.rounds < 1 or not 1 <= options.quantity <= 125:
        parser.error("more than 0 seconds, 1 round or more, 1 to 125 registers")
    return options


def start_servers(
    options: argparse.Namespace, core: int, stack: contextlib.ExitStack
) -> list[Server]:
    """All servers, the one first that the others are compared with. The bare loop learns from
    Holdfast what to answer.
    """

    def start(name: str, *command: str) -> Server:
        server = Server(name, list(command), core)
        stack.callback(server.stop)
        return server

    folder = str(ROOT / "benches")
    holdfast = start("holdfast", sys.executable, f"{folder}/holdfast_server.py")
    reply = ask(holdfast.address, options.quantity)
    limit = (str(TARGET / "bare"), "--request-len", str(len(REQUEST)), "--reply", reply.hex())
    bare = start("bare", *limit)
    if options.null:
        return [bare, start("bare again", *limit)]
    pymodbus = start("pymodbus", sys.executable, f"{folder}/pymodbus_server.py")
    if ask(pymodbus.address, options.quantity) != reply:
        raise RuntimeError("pymodbus does not answer the same bytes")
    return [holdfast, bare, pymodbus]


def ask(address: str, quantity: int) -> bytes:
    """The reply to one read."""
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


def measure(
    servers: list[Server],
    connections: int,
    in_flight: int,
    options: argparse.Namespace,
    core: int,
) -> Scenario:
    """Every server once a round; a round begins with another server each time."""
    scenario = Scenario(connections, in_flight)
    for index in range(options.rounds):
        first = index % len(servers)
        results: dict[str, Result] = {}
        for server in servers[first:] + servers[:first]:
            if server.name in scenario.failures:
                continue
            try:
                results[server.name] = load(server, (connections, in_flight), options, core)
            except TurnFailed as failure:
                scenario.failures[server.name] = str(failure)
        scenario.rounds.append(results)
    return scenario


def load(server: Server, shape: tuple[int, int], options: argparse.Namespace, core: int) -> Result:
    """One turn: what the load says, and the server's processor time for each request."""
    before = server.cpu()
    with running_load(server, shape, options.seconds, options.quantity, core) as process:
        try:
            out, error = process.communicate(timeout=options.seconds + PATIENCE)
        except subprocess.TimeoutExpired:
            raise TurnFailed("the load did not end") from None
    if process.returncode != 0:
        raise TurnFailed(error.strip())
    result: Result = json.loads(out)
    # Not only what counts: the server works for the warm-up and the last replies too.
    result["server_us"] = (server.cpu() - before) / result["answered"] * 1e6
    return result


def beside_a_flood(server: Server, options: argparse.Namespace, core: int) -> dict[str, Result]:
    """What one polite client sees, alone and beside clients that never pause. All share a core."""
    alone = load(server, (1, 1), options, core)
    with running_load(server, FLOOD, options.seconds + 2, options.quantity, core):
        return {"alone": alone, "beside": load(server, (1, 1), options, core)}


@contextlib.contextmanager
def running_load(
    server: Server, shape: tuple[int, int], seconds: float, quantity: int, core: int
) -> Iterator[subprocess.Popen[str]]:
    connections, in_flight = shape
    command = [
        str(TARGET / "load"),
        *("--address", server.address),
        *("--connections", str(connections)),
        *("--in-flight", str(in_flight)),
        *("--quantity", str(quantity)),
        *("--seconds", str(seconds)),
    ]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, {core}),
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def show(scenario: Scenario, names: list[str]) -> None:
    """One table. `load's core` is how busy the load was: near 100 % it is a limit too."""
    print(f"\n{scenario.connections} connections, {scenario.in_flight} in flight on each:")
    print(
        "  server      requests/s   p50 us   p99 us  cpu us/request  load's core"
        f"  {names[0]} against it (min to max)"
    )
    for name in names:
        measured = [one[name] for one in scenario.rounds if name in one]
        if name in scenario.failures:
            print(f"  {name:10}  failed: {scenario.failures[name]}")
        elif measured:
            rate, p50, p99, cpu, busy = (
                median(one[key] for one in measured)
                for key in ("rate", "p50", "p99", "server_us", "busy")
            )
            print(
                f"  {name:10}  {rate:10,.0f}  {p50:7.1f}  {p99:7.1f}  {cpu:14.2f}  {busy:10.0%} "
                f"  {against(scenario, names[0], name)}".rstrip()
            )
    sys.stdout.flush()


def against(scenario: Scenario, first: str, name: str) -> str:
    """The ratio of the rates within a round."""
    both = [one for one in scenario.rounds if first in one and name in one]
    if name == first or not both:
        return ""
    ratios = [one[first]["rate"] / one[name]["rate"] for one in both]
    return f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


def show_flood(beside: dict[str, Result]) -> None:
    if beside:
        print("\nholdfast, 1 connection with 1 in flight, alone and beside two that flood it:")
    for name, result in beside.items():
        print(f"  {name:6}  p50 {result['p50']:,.0f} us, p99 {result['p99']:,.0f} us")


if __name__ == "__main__":
    main()
