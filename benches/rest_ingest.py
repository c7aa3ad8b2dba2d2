"""Compares ingest over REST with a loop that only parses the same JSON.

The appliance has one core, the load has the other. The load is written in Rust; it keeps
connections, has one request in flight on each, and checks all answers. The loop runs on the
appliance's core while that is idle. It has no socket and no HTTP: it parses the body with msgspec,
as the appliance does, and packs the values with `struct`. The same loop with the standard library's
`json` is shown for information.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

import common
from common import Result, Server

TOKEN = "a token that protects nothing"
CONNECTIONS = (1, 8)
VALUES = 1000
# The number of commands that the values are split into.
BODIES = {"one command": 1, "10 commands": 10}
CONFIGURATION = f"""
memories:
  plant: {{holding_registers: {VALUES}}}
rest:
  bind: 127.0.0.1:0
  sources: [127.0.0.1]
  tokens:
    - name: benchmark
      sha256: {hashlib.sha256(TOKEN.encode()).hexdigest()}
      memories: [plant]
      areas: [holding_registers]
      access: read-write
"""


@dataclass
class Scenario:
    """The results for one kind of body and one number of connections."""

    body: str
    connections: int
    bytes: int
    rounds: list[dict[str, Result]] = field(default_factory=list)


def main() -> None:
    """Prints a table for each scenario, and writes all results to the file of `--json`."""
    options = common.parsed(common.parser(__doc__, seconds=2, rounds=7))
    scenarios = []
    with (
        common.appliance(CONFIGURATION, options.core, listeners=1) as holdfast,
        tempfile.TemporaryDirectory() as folder,
    ):
        for kind, commands in BODIES.items():
            file = Path(folder) / "body.json"
            file.write_bytes(body(commands))
            for connections in CONNECTIONS:
                scenario = Scenario(kind, connections, file.stat().st_size)
                measure(scenario, file, holdfast, options)
                show(scenario)
                scenarios.append(scenario)
    if options.json:
        options.json.write_text(json.dumps([asdict(one) for one in scenarios], indent=1))


def body(commands: int) -> bytes:
    """Returns all values in this many commands. The values have one to five digits."""
    values = [(address * 7919) % 65536 >> address % 16 for address in range(VALUES)]
    each = VALUES // commands
    batch = [
        {
            "memory": "plant",
            "area": "holding_registers",
            "address": at,
            "values": values[at : at + each],
        }
        for at in range(0, VALUES, each)
    ]
    return json.dumps(batch if commands > 1 else batch[0], separators=(",", ":")).encode()


def measure(scenario: Scenario, file: Path, holdfast: Server, options: argparse.Namespace) -> None:
    """Measures the appliance and both loops once per round."""
    address, body = holdfast.address, file.read_bytes()
    request = common.http_request(address, "/api/v1/ingest", token=TOKEN, body=body)
    post = common.http_load(address, file.with_name("request"), request, scenario.connections)
    for index in range(options.rounds):
        results = {}
        for name in common.turns(["holdfast", "msgspec", "json"], index):
            if name == "holdfast":
                results[name] = common.load(post, options.seconds, options.other, holdfast)
            else:
                command = common.python("parse_loop.py", file, name, options.seconds)
                results[name] = common.outcome(command, options.seconds, options.core)
        scenario.rounds.append(results)


def show(scenario: Scenario) -> None:
    """Prints one table."""
    rounds = scenario.rounds
    print(f"\n{scenario.body}, {VALUES} values, {scenario.bytes:,} bytes,", end=" ")
    print(f"{scenario.connections} connections:")
    print("              values/s   us/request  ratio of holdfast (min to max)")
    for name in ("holdfast", "msgspec", "json"):
        [rate] = common.medians(rounds, name, "rate")
        against = "" if name == "holdfast" else common.ratio(rounds, "holdfast", name)
        print(f"  {name:8}  {rate * VALUES:12,.0f}   {1e6 / rate:10.1f}  {against}".rstrip())
    p50, p99, cpu, busy = common.medians(rounds, "holdfast", "p50", "p99", "server_us", "busy")
    print(
        f"  holdfast: p50 {p50:,.0f} us, p99 {p99:,.0f} us, cpu {cpu:,.0f} us per request;", end=""
    )
    print(f" the load was busy for {busy:.0%}.")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
