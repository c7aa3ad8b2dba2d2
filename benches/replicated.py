"""Compares writes to a replicated memory with a bare publisher to the same NATS server.

64 Modbus clients write one register each, one after another, to an appliance whose memory is
replicated through a log; or 64 bare publishers (async-nats) send messages of the same size, each
when the last one is acknowledged. Both run for the same time, one after the other; ratios compare
results of the same round. A message of the log carries the steps that wait together, so there are
fewer messages than writes.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import common

CONNECTIONS = 64
CONFIGURATION = """
memories: {{plant: {{holding_registers: 100, replicate: {{log: speed}}}}}}
logs: {{speed: {{servers: ["{url}"], node: a, write_timeout: 10}}}}
listeners:
  scada:
    type: modbus-tcp
    max_connections_per_source: null
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant}}, access: read-write}}]
rest: {{bind: 127.0.0.1:0, sources: [127.0.0.0/8], tokens: none}}
"""


def main() -> None:
    """Prints the rates and their ratio, and the load of the machine."""
    options = common.parsed(common.parser(__doc__, seconds=3, rounds=5))
    print(f"load of the machine at the beginning: {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        url, server = nats(Path(folder), options.core)
        try:
            rounds = compared(url, options)
        finally:
            server.kill()
            server.wait()
    for name, unit in (("log", "writes"), ("bare", "messages")):
        rate, p50 = common.medians(rounds, name, "rate", "p50")
        print(f"{name}: {rate:,.0f} {unit}/s, p50 {p50 / 1000:.2f} ms")
    print(
        "writes/s of the log to messages/s of the publisher:", common.ratio(rounds, "log", "bare")
    )
    print("messages/s of both:", common.ratio(rounds, "log", "bare", key="messages"))
    print(f"load of the machine at the end: {os.getloadavg()[0]:.1f}")
    if options.json:
        options.json.write_text(json.dumps(rounds, indent=1))


def compared(url: str, options: Any) -> list[dict[str, dict[str, float]]]:
    """Measures both in each round, in turns."""
    rounds = []
    with common.appliance(CONFIGURATION.format(url=url), options.core, 2) as appliance:
        log = common.bench("load", "--address", appliance.addresses["scada"])
        log += ["--request", "write-registers", "--quantity", "1", "--in-flight", "1"]
        log += ["--connections", str(CONNECTIONS)]
        bare = common.bench("publish", "--url", url, "--publishers", CONNECTIONS)
        for index in range(options.rounds):
            one = {}
            for name in common.turns(["log", "bare"], index):
                command = [*(log if name == "log" else bare), "--seconds", str(options.seconds)]
                before = sequence(appliance.addresses["rest"])
                result = common.outcome(command, options.seconds, options.other)
                sent = sequence(appliance.addresses["rest"]) - before
                # The load counts the replies of its warm-up apart.
                share = result["requests"] / result["answered"]
                result["messages"] = result["rate"] if name == "bare" else sent * share
                if name == "log":
                    result["messages"] /= options.seconds
                one[name] = result
            rounds.append(one)
    return rounds


def sequence(address: str) -> int:
    """The last sequence of the log that the appliance has applied."""
    with urllib.request.urlopen(f"http://{address}/api/v1/diagnostics/stats") as reply:
        found: int = json.load(reply)["logs"]["speed"]["sequence"]
    return found


def nats(folder: Path, core: int) -> tuple[str, subprocess.Popen[bytes]]:
    """Starts a NATS server with JetStream."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    program = Path(sys.executable).parent / "nats-server"
    options = ["-a", "127.0.0.1", "-p", str(port), "-js", "-sd", str(folder)]
    server = subprocess.Popen(
        [str(program), *options], stderr=subprocess.DEVNULL, preexec_fn=common.pinned(core)
    )
    deadline = time.monotonic() + common.TIMEOUT
    while server.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            time.sleep(0.01)
            continue
        return f"nats://127.0.0.1:{port}", server
    server.kill()
    raise RuntimeError(f"{program} did not start")


if __name__ == "__main__":
    main()
