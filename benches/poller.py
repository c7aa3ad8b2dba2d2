"""Measures the native poller at full speed, and with 1,000 devices at an interval of 1 s.

One server on the first core stands for all devices; the poller has the last core. At full speed,
64 devices with one read in flight each are compared with a bare client with 64 connections and one
request in flight on each.
"""

from __future__ import annotations

import json

import common

CONNECTIONS = 64
DEVICES = 1000


def main() -> None:
    parser = common.parser(__doc__, seconds=3, rounds=5)
    parser.add_argument("--devices", type=int, default=DEVICES)
    options = common.parsed(parser)
    with common.started("device", common.python("devices.py"), options.core) as server:
        port = server.address.rpartition(":")[2]
        rounds: list[common.Round] = []
        for index in range(options.rounds):
            turn: dict[str, common.Result] = {}
            for name in common.turns(("poller", "bare"), index):
                if name == "poller":
                    command = common.python("poller_mirror.py", port, CONNECTIONS, 0)
                    command.append(str(options.seconds))
                else:
                    command = common.bench(
                        *("load", "--address", server.address, "--quantity", 10),
                        *("--connections", CONNECTIONS, "--in-flight", 1),
                        *("--seconds", options.seconds),
                    )
                turn[name] = common.outcome(command, options.seconds, options.other)
            rounds.append(turn)
        show_flat_out(rounds)
        command = common.python("poller_mirror.py", port, options.devices, 1.0)
        result = common.outcome(
            [*command, str(5 * options.seconds)], 5 * options.seconds, options.other
        )
    show_schedule(options.devices, result)
    if options.json:
        options.json.write_text(json.dumps({"flat_out": rounds, "schedule": result}, indent=1))


def show_flat_out(rounds: list[common.Round]) -> None:
    poller, bare = (common.medians(rounds, name, "rate")[0] for name in ("poller", "bare"))
    print(f"\nFull speed, {CONNECTIONS} connections, one read of 10 registers in flight on each:")
    print(f"  poller  {poller:9,.0f} blocks/s    bare client  {bare:9,.0f} requests/s")
    print(f"  ratio of poller to bare client: {common.ratio(rounds, 'poller', 'bare')}")


def show_schedule(devices: int, result: common.Result) -> None:
    print(f"\n{devices} devices of 10 blocks, polled every second:")
    print(
        f"  {result['rate']:,.0f} blocks/s, {result['cpu']:.0%} of a core, "
        f"{result['missed']:.0f} scans missed, {result['timeouts']:.0f} timeouts, "
        f"{result['transport_errors']:.0f} transport errors"
    )


if __name__ == "__main__":
    main()
