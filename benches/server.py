"""Compares the server with that of pymodbus and with a bare loop.

The measured server has one core, the load the other. All servers run all the time, but only one is
under load at a time. Their order rotates, so that changes of the machine's speed affect all alike.
Ratios compare results of the same round; figures are the medians of all rounds. A server that drops
or changes a reply is reported as failed, and not measured again in that scenario.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from math import exp, log, sqrt
from statistics import fmean, stdev

import common
from common import Result, Server, TurnFailed

FLOOD = (2, 3000)
BOUND_ROUNDS = 10
"""The fewest rounds for a bound of their mean."""
STUDENT_T = 1.833
"""The 95 % quantile for 9 degrees of freedom; it is smaller for more."""

SHAPES = [(connections, in_flight) for connections in (1, 64) for in_flight in (1, 16)]


@dataclass
class Scenario:
    """The results for one number of connections and one number of requests in flight on each."""

    connections: int
    in_flight: int
    rounds: list[dict[str, Result]] = field(default_factory=list)
    failures: dict[str, str] = field(default_factory=dict)


def main() -> None:
    """Prints a table for each scenario, and writes all results to the file of `--json`."""
    options = arguments()
    with ExitStack() as stack:
        servers = start_servers(options, stack)
        scenarios = []
        for connections, in_flight in options.shape or SHAPES:
            scenarios.append(measure(servers, connections, in_flight, options))
            show(scenarios[-1], list(servers))
        is_all = not (options.null or options.shape)
        beside = beside_a_flood(servers["holdfast"], options) if is_all else {}
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
    parser = common.parser(__doc__, seconds=2, rounds=7)
    parser.add_argument("--null", action="store_true", help="compare the bare loop with itself")
    parser.add_argument("--quantity", type=int, default=10, help="registers per read, 1 to 125")
    parser.add_argument(
        "--shape",
        action="append",
        type=shape,
        metavar="CONNECTIONSxIN_FLIGHT",
        help="only this, without pymodbus, such as 64x1; can be repeated",
    )
    options = common.parsed(parser)
    if not 1 <= options.quantity <= 125:
        parser.error("--quantity must be 1 to 125")
    return options


def shape(text: str) -> tuple[int, int]:
    """Parses the connections, and the requests in flight on each."""
    found = re.fullmatch("([1-9][0-9]*)x([1-9][0-9]*)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not CONNECTIONSxIN_FLIGHT, as in 64x1")
    return int(found[1]), int(found[2])


def start_servers(options: argparse.Namespace, stack: ExitStack) -> dict[str, Server]:
    """Starts all servers. The others are compared with the first.

    The bare loop answers with a reply of Holdfast.
    """
    servers: dict[str, Server] = {}

    def start(name: str, command: list[str]) -> str:
        servers[name] = stack.enter_context(common.started(name, command, options.core))
        return servers[name].address

    address = start("holdfast", common.python("holdfast_server.py"))
    reply = common.ask(address, options.quantity)
    limit = common.bench("bare", "--request-len", len(common.REQUEST), "--reply", reply.hex())
    start("bare", limit)
    if options.null:
        start("bare again", limit)
        del servers["holdfast"]
        return servers
    if options.shape:
        return servers
    address = start("pymodbus", common.python("pymodbus_server.py"))
    if common.ask(address, options.quantity) != reply:
        raise RuntimeError("the reply of pymodbus differs from the reply of Holdfast")
    return servers


def measure(
    servers: dict[str, Server], connections: int, in_flight: int, options: argparse.Namespace
) -> Scenario:
    """Measures every server once per round."""
    scenario = Scenario(connections, in_flight)
    for index in range(options.rounds):
        results: dict[str, Result] = {}
        for name in common.turns(list(servers), index):
            if name in scenario.failures:
                continue
            try:
                results[name] = load(servers[name], (connections, in_flight), options)
            except TurnFailed as failure:
                scenario.failures[name] = str(failure)
        scenario.rounds.append(results)
    return scenario


def load(server: Server, shape: tuple[int, int], options: argparse.Namespace) -> Result:
    return common.load(command(server, shape, options), options.seconds, options.other, server)


def command(server: Server, shape: tuple[int, int], options: argparse.Namespace) -> list[str]:
    connections, in_flight = shape
    return common.bench(
        "load",
        *("--address", server.address),
        *("--connections", connections),
        *("--in-flight", in_flight),
        *("--quantity", options.quantity),
    )


def beside_a_flood(server: Server, options: argparse.Namespace) -> dict[str, Result]:
    """Measures one polite client alone, and beside clients that flood the server."""
    alone = load(server, (1, 1), options)
    flood = [*command(server, FLOOD, options), "--seconds", str(options.seconds + 2)]
    with common.running(flood, options.other):
        return {"alone": alone, "beside": load(server, (1, 1), options)}


def show(scenario: Scenario, names: list[str]) -> None:
    """Prints one table. A `load's core` near 100 % means that the load limits the result."""
    print(f"\n{scenario.connections} connections, {scenario.in_flight} in flight on each:")
    print(
        "  server      requests/s   p50 us   p99 us  cpu us/request  load's core"
        f"  ratio of {names[0]} (min to max)"
    )
    for name in names:
        if name in scenario.failures:
            print(f"  {name:10}  failed: {scenario.failures[name]}")
            continue
        rate, p50, p99, cpu, busy = common.medians(
            scenario.rounds, name, "rate", "p50", "p99", "server_us", "busy"
        )
        against = "" if name == names[0] else compared(scenario.rounds, names[0], name)
        print(
            f"  {name:10}  {rate:10,.0f}  {p50:7.1f}  {p99:7.1f}  {cpu:14.2f}  {busy:10.0%}"
            f"   {against}".rstrip()
        )
    sys.stdout.flush()


def compared(rounds: list[dict[str, Result]], first: str, second: str) -> str:
    """Formats the ratio of two servers; from 10 rounds on with the lower bound of its mean (95 %).

    The bound is Student's, one-sided, for the logarithms of the rounds' ratios.
    """
    shown = common.ratio(rounds, first, second)
    both = [one for one in rounds if first in one and second in one]
    ratios = [log(one[first]["rate"] / one[second]["rate"]) for one in both]
    if len(ratios) < BOUND_ROUNDS:
        return shown
    bound = fmean(ratios) - STUDENT_T * stdev(ratios) / sqrt(len(ratios))
    return f"{shown}, mean {exp(fmean(ratios)):.3f}, at least {exp(bound):.3f}"


def show_flood(beside: dict[str, Result]) -> None:
    if beside:
        print("\nholdfast, 1 connection with 1 in flight, alone and beside a flood of 2:")
    for name, result in beside.items():
        print(f"  {name:6}  p50 {result['p50']:,.0f} us, p99 {result['p99']:,.0f} us")


if __name__ == "__main__":
    main()
