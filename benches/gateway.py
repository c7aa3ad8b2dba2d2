"""Measures reads of ten registers through the HTTP gateway, with kept and with new connections.

The gateway has one core. The load and the device, a Holdfast server, share the other. Each client
has one request in flight. The load with kept connections is written in Rust. The load with one
connection per request is written in Python; if it is busy all the time, the figures show its limit
instead of the gateway's. All replies are checked.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import common
from common import Result

CLIENTS = 32
QUANTITY = 10
PATH = "/api/modbus/read"
KINDS = {"kept": "kept connections", "once": "one connection per request"}


def main() -> None:
    """Prints a table, and writes all results to the file of `--json`."""
    options = common.parsed(common.parser(__doc__, seconds=2, rounds=7))
    rounds: list[dict[str, Result]] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        common.started("device", common.python("holdfast_server.py"), options.other) as device,
        common.started(
            "gateway", common.python("holdfast_gateway.py", device.address), options.core
        ) as gateway,
    ):
        host, _, port = device.address.rpartition(":")
        file = Path(folder) / "body.json"
        read = {"functionCode": 3, "address": 0, "quantity": QUANTITY}
        file.write_text(json.dumps({"host": host, "port": int(port), **read}))
        load = [
            *("--address", gateway.address),
            *("--path", PATH),
            *("--body", file),
            *("--connections", CLIENTS),
        ]
        loads = {"kept": common.bench("post", *load), "once": common.python("post_once.py", *load)}
        for index in range(options.rounds):
            rounds.append(
                {
                    name: common.load(loads[name], options.seconds, options.other, gateway)
                    for name in common.turns(list(loads), index)
                }
            )
    show(rounds)
    if options.json:
        options.json.write_text(json.dumps(rounds, indent=1))


def show(rounds: list[dict[str, Result]]) -> None:
    """Prints the table."""
    print(f"\nReads of {QUANTITY} registers of one device, {CLIENTS} clients:")
    print("                              reads/s  p50 ms  p99 ms  gateway us/read  load busy")
    for name, title in KINDS.items():
        figures = common.medians(rounds, name, "rate", "p50", "p99", "server_us", "busy")
        rate, p50, p99, cpu, busy = figures
        print(
            f"  {title:25}  {rate:8,.0f}  {p50 / 1e3:6.1f}  {p99 / 1e3:6.1f}  {cpu:15,.0f}"
            f"  {busy:9.0%}"
        )
    print(f"  ratio of kept to new connections: {common.ratio(rounds, 'kept', 'once')}")


if __name__ == "__main__":
    main()
