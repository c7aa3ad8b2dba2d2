"""Measures the server against pymodbus's and against a bare loop, in turn, on one machine.

The server that is measured has one core, the load the other. All servers run all the time; only one
is loaded at once, and the turns go round, so that a machine whose speed drifts treats all alike.
What is compared is the ratio within one round; what is told is the median of all rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import socket
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import TypeAlias

ROOT = Path(__file__).parent.parent
TARGET = ROOT / "target" / "release"
SERVERS = ("holdfast", "bare", "pymodbus")
FLOOD = (2, 3000)
SCENARIOS = [(connections, in_flight) for connections in (1, 64) for in_flight in (1, 16)]
REQUEST = bytes.fromhex("123400000006010300000000")
TICKS = os.sysconf("SC_CLK_TCK")

Result: TypeAlias = dict[str, float]


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
        word, _, address = self.process.stdout.readline().strip().partition(" ")
        if word != "listening":
            raise RuntimeError(f"{name} did not start")
        self.address = address

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
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        print("Only one core: server and load share it, so ratios say little.")
    with contextlib.ExitStack() as stack:
        servers = start_servers(options.quantity, cores[0], stack)
        results = {
            scenario: measure(servers, scenario, options, cores[-1]) for scenario in SCENARIOS
        }
        beside = beside_a_flood(servers[0], options, cores[-1])
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()};")
    print(f"{options.rounds} rounds of {options.seconds} s, {options.quantity} registers a read.")
    for scenario, rounds in results.items():
        show(scenario, rounds)
    print("\nholdfast, 1 connection with 1 in flight, alone and beside two that flood it:")
    for name, result in beside.items():
        print(f"  {name:6}  p50 {result['p50']:,.0f} us, p99 {result['p99']:,.0f} us")
    if options.json:
        flat = [
            {"connections": connections, "in_flight": in_flight, "rounds": rounds}
            for (connections, in_flight), rounds in results.items()
        ]
        options.json.write_text(json.dumps(flat, indent=1))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0, help="of load in each turn")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--quantity", type=int, default=10, help="registers a read, 1 to 125")
    parser.add_argument("--json", type=Path, help="where to write all results")
    return parser.parse_args()


def start_servers(quantity: int, core: int, stack: contextlib.ExitStack) -> list[Server]:
    """All servers. The bare loop learns from the first what to answer."""

    def start(name: str, *command: str) -> Server:
        server = Server(name, list(command), core)
        stack.callback(server.stop)
        return server

    folder = str(ROOT / "benches")
    holdfast = start("holdfast", sys.executable, f"{folder}/holdfast_server.py")
    reply = ask(holdfast.address, quantity)
    bare = start("bare", str(TARGET / "bare"), "--request-len", "12", "--reply", reply.hex())
    pymodbus = start("pymodbus", sys.executable, f"{folder}/pymodbus_server.py")
    if ask(pymodbus.address, quantity) != reply:
        raise RuntimeError("pymodbus does not answer the same bytes")
    return [holdfast, bare, pymodbus]


def ask(address: str, quantity: int) -> bytes:
    """The reply to one read."""
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as connection:
        connection.sendall(REQUEST[:-2] + quantity.to_bytes(2, "big"))
        reply = b""
        while len(reply) < 9 + 2 * quantity:
            reply += connection.recv(300)
        return reply


def measure(
    servers: list[Server], scenario: tuple[int, int], options: argparse.Namespace, core: int
) -> list[dict[str, Result]]:
    """Every server once a round; a round begins with another server each time."""
    rounds = []
    for index in range(options.rounds):
        turn = servers[index % len(servers) :] + servers[: index % len(servers)]
        results = {server.name: load(server, scenario, options, core) for server in turn}
        rounds.append(results)
    return rounds


def load(
    server: Server, scenario: tuple[int, int], options: argparse.Namespace, core: int
) -> Result:
    before = server.cpu()
    done = start_load(server, scenario, options.seconds, options.quantity, core)
    out, error = done.communicate(timeout=options.seconds + 30)
    if done.returncode != 0:
        raise RuntimeError(f"{server.name}, {scenario}: {error.strip()}")
    result: Result = json.loads(out)
    # The load warms up before it counts: the server works for that time too.
    share = options.seconds / (options.seconds + 0.3)
    result["server_us"] = (server.cpu() - before) * share / max(1, result["requests"]) * 1e6
    return result


def beside_a_flood(server: Server, options: argparse.Namespace, core: int) -> dict[str, Result]:
    """What one polite client sees, alone and beside clients that never pause. All share a core."""
    alone = load(server, (1, 1), options, core)
    flood = start_load(server, FLOOD, options.seconds + 2, options.quantity, core)
    try:
        return {"alone": alone, "beside": load(server, (1, 1), options, core)}
    finally:
        flood.kill()
        flood.communicate()


def start_load(
    server: Server, scenario: tuple[int, int], seconds: float, quantity: int, core: int
) -> subprocess.Popen[str]:
    connections, in_flight = scenario
    command = [
        str(TARGET / "load"),
        *("--address", server.address),
        *("--connections", str(connections)),
        *("--in-flight", str(in_flight)),
        *("--quantity", str(quantity)),
        *("--seconds", str(seconds)),
    ]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, {core}),
    )


def show(scenario: tuple[int, int], rounds: list[dict[str, Result]]) -> None:
    connections, in_flight = scenario
    print(f"\n{connections} connections, {in_flight} in flight on each:")
    print("  server      requests/s   p50 us   p99 us  cpu us/request  against it (min to max)")
    for name in SERVERS:
        told = {
            key: median(one[name][key] for one in rounds)
            for key in ("rate", "p50", "p99", "server_us")
        }
        ratios = [one["holdfast"]["rate"] / one[name]["rate"] for one in rounds]
        against = f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        print(
            f"  {name:10}  {told['rate']:10,.0f}  {told['p50']:7.1f}  {told['p99']:7.1f}"
            f"  {told['server_us']:14.2f}  {'' if name == 'holdfast' else against}"
        )


if __name__ == "__main__":
    main()
