"""Compares a route to a device with the device itself, with modbus-proxy and with mbusd.

The load has one core, devices and gateways share the other: a request crosses between cores as
often on each way. All run all the time, but only one is under load at a time. Their order rotates,
so that changes of the machine's speed affect all alike. Ratios compare results of the same round;
figures are the medians of all rounds.

All clients read the same registers, which is why coalescing is off unless named. modbus-proxy and
mbusd are measured if their commands are found; mbusd pauses at least 1 ms between requests.
"""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from typing import IO, Any

import common
from common import Result, TurnFailed

CONNECTIONS = (1, 8, 50)
BAUD = 115_200


class Foreign:
    """A gateway of others. It listens on a port that was free a moment ago."""

    def __init__(self, command: list[str], core: int, log: IO[str]) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self.address = f"127.0.0.1:{port}"
        command = [word.replace("{port}", str(port)) for word in command]
        self.process = subprocess.Popen(
            command, stdout=log, stderr=log, preexec_fn=common.pinned(core)
        )
        deadline = time.monotonic() + common.TIMEOUT
        while self.process.poll() is None and time.monotonic() < deadline:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
            except OSError:
                continue
            return
        log.seek(0)
        raise RuntimeError(f"{command[0]} did not start: {log.read()[-2000:]}")

    def cpu(self) -> float:
        """Returns the processor time so far, in seconds."""
        return time.clock_gettime(~self.process.pid << 3 | 2)

    def stop(self) -> None:
        """Kills the process."""
        self.process.kill()
        self.process.wait()


def main() -> None:
    """Prints a table for each kind of device, and writes all results to the file of `--json`."""
    options = common.parsed(common.parser(__doc__, seconds=1.5, rounds=9))
    with ExitStack() as stack:
        results = [tcp(options, stack), serial(options, stack)]
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


def tcp(options: Any, stack: ExitStack) -> list[Any]:
    """A device on Modbus TCP."""
    start = common.started
    device = stack.enter_context(start("device", common.python("holdfast_server.py"), options.core))
    servers: dict[str, Any] = {"direct": device}
    ways = {
        "holdfast": (1, "apart"),
        "holdfast, 8 in flight": (8, "apart"),
        "holdfast, coalescing": (1, "together"),
    }
    for name, way in ways.items():
        command = common.python("holdfast_route.py", f"tcp://{device.address}", *way)
        servers[name] = stack.enter_context(start(name, command, options.core))
    if shutil.which("modbus-proxy"):
        command = ["modbus-proxy", "-b", "127.0.0.1:{port}", "--modbus", f"tcp://{device.address}"]
        servers["modbus-proxy"] = foreign(command, options, stack)
    return [measure("TCP device", servers, count, options) for count in CONNECTIONS]


def serial(options: Any, stack: ExitStack) -> list[Any]:
    """An RTU device behind a pseudo-terminal, which answers at once."""
    command = common.python("rtu_device.py", "holdfast", "mbusd")
    lines = stack.enter_context(common.started("device", command, options.core, 2))
    url = f"rtu://{lines.addresses['holdfast']}?baud={BAUD}&parity=none&silence=0.001"
    command = common.python("holdfast_route.py", url, 1, "apart")
    servers: dict[str, Any] = {
        "holdfast": stack.enter_context(common.started("holdfast", command, options.core))
    }
    if shutil.which("mbusd"):
        command = ["mbusd", "-d", "-L-", "-v0", "-p", lines.addresses["mbusd"], "-s", str(BAUD)]
        command += [
            "-m",
            "8N1",
            "-A",
            "127.0.0.1",
            "-P",
            "{port}",
            "-R",
            "1",
            "-N",
            "0",
            "-C",
            "99",
        ]
        servers["mbusd"] = foreign(command, options, stack)
    return [measure("RTU device", servers, count, options) for count in CONNECTIONS]


def foreign(command: list[str], options: Any, stack: ExitStack) -> Foreign:
    """Starts a gateway of others."""
    log: IO[str] = stack.enter_context(tempfile.TemporaryFile("w+"))  # noqa: SIM115
    gateway = Foreign(command, options.core, log)
    stack.callback(gateway.stop)
    return gateway


def measure(title: str, servers: dict[str, Any], connections: int, options: Any) -> Any:
    """Measures every way once per round, and prints the table."""
    rounds: list[dict[str, Result]] = []
    failures: dict[str, str] = {}
    for index in range(options.rounds):
        rounds.append({})
        for name in common.turns(list(servers), index):
            command = common.bench("load", "--address", servers[name].address)
            command += ["--connections", str(connections), "--in-flight", "1", "--quantity", "10"]
            try:
                rounds[-1][name] = common.load(
                    command, options.seconds, options.other, servers[name]
                )
            except TurnFailed as failure:
                failures[name] = str(failure)
    first = "holdfast"
    print(f"\n{title}, {connections} connections, one request at a time on each:")
    print("  way                     requests/s   p50 us   p99 us  cpu us  holdfast / way")
    for name in servers:
        if not any(name in one for one in rounds):
            print(f"  {name:22}  failed: {failures[name]}")
            continue
        rate, p50, p99, cpu = common.medians(rounds, name, "rate", "p50", "p99", "server_us")
        compared = common.ratio(rounds, first, name)
        print(f"  {name:22} {rate:11,.0f} {p50:8.0f} {p99:8.0f} {cpu:7.1f}  {compared}")
    sys.stdout.flush()
    return {"title": title, "connections": connections, "rounds": rounds, "failures": failures}


if __name__ == "__main__":
    main()
