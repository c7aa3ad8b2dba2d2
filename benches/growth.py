"""Measures how the cost of a request, a device and a tag grows with their number.

The server has one core, the load the other. A server's cost is its processor time for each request;
that of a poller its processor time for each device or tag. Every table begins with the smallest
number; where the last column stays near 1, the cost of all grows as their number does. `--plot`
draws that column into a picture.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import common

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

CONFIGURATION = """
workers: {workers}
memories:
{memories}
listeners:
  modbus:
    type: modbus-tcp
    bind: 127.0.0.1:0
    max_connections: 20000
    max_connections_per_source: null
    rules: [{{sources: [127.0.0.0/8], units: {{{units}}}, access: read-only}}]
"""
SHAPE = [64, 1, 10]
"""Connections, requests in flight on each, and registers in each."""


@dataclass
class Growth:
    """What was measured with a growing number of something."""

    of: str
    unit: str
    numbers: Sequence[int]
    rounds: list[dict[int, common.Result]] = field(default_factory=list)

    def measure(self, turn: Callable[[int], common.Result]) -> None:
        """Measures each number once."""
        self.rounds.append({number: turn(number) for number in self.numbers})

    def figures(self, key: str) -> list[float]:
        """The medians of a figure, for each number."""
        return [median(each[number][key] for each in self.rounds) for number in self.numbers]

    def costs(self) -> list[float]:
        """How the cost of one compares with that of the first row."""
        costs = self.figures("cost")
        return [each / costs[0] for each in costs]

    def show(self) -> None:
        """Prints a table."""
        print(f"\n| {self.of} | {self.unit}/s | cost of one, µs | of the first row |")
        print("| --- | --- | --- | --- |")
        rows = zip(
            self.numbers, self.figures("rate"), self.figures("cost"), self.costs(), strict=True
        )
        for number, rate, cost, ratio in rows:
            print(f"| {number:,} | {rate:,.0f} | {cost:.2f} | {ratio:.2f} |", flush=True)


def main() -> None:
    """Prints a table for each kind of growth, and writes all results to the file of `--json`."""
    parser = common.parser(__doc__, seconds=2, rounds=3)
    parser.add_argument("--plot", type=Path, help="file for a picture, SVG")
    options = common.parsed(parser)
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    most = 10 if options.quick else min(20_000, hard - 500)
    servers = [
        Growth("connections", "requests", [*(10**n for n in range(5) if 10**n < most), most]),
        Growth("requests in flight on each of 16 connections", "requests", [1, 4, 16, 64, 256]),
        Growth("registers of a read, 64 connections", "requests", [1, 10, 50, 125]),
        Growth("memories, 64 connections", "requests", [1, 10, 100, 247]),
        Growth("worker threads on one core, 64 connections", "requests", [1, 2, 4, 8]),
    ]
    pollers = [
        Growth("devices of 10 blocks, every second", "blocks", [10, 100, 1000, 10_000]),
        Growth("tags of each of 100 devices, every second", "readings", [1, 10, 100, 400]),
    ]
    if options.quick:
        pollers = [Growth(each.of, each.unit, each.numbers[:2]) for each in pollers]
    turns = [
        *(server_turn(options, at) for at in range(len(servers))),
        *(poller_turn(options, script) for script in ("poller_mirror.py", "polled_tags.py")),
    ]
    for growth, turn in zip([*servers, *pollers], turns, strict=True):
        for _ in range(options.rounds):
            growth.measure(turn)
        growth.show()
    found = [*servers, *pollers]
    if options.plot:
        options.plot.write_text(picture(found))
    if options.json:
        options.json.write_text(json.dumps({each.of: each.rounds for each in found}, indent=1))


def server_turn(options: argparse.Namespace, at: int) -> Callable[[int], common.Result]:
    """Measures a server; the number stands at this place of the shape, or for memories, workers."""

    def turn(number: int) -> common.Result:
        shape = SHAPE.copy()
        if at == 1:
            shape[0] = 16
        if at < len(shape):
            shape[at] = number
        memories = number if at == 3 else 1
        text = CONFIGURATION.format(
            workers=number if at == 4 else 1,
            memories="\n".join(f"  m{n}: {{holding_registers: 1000}}" for n in range(memories)),
            units=", ".join(f"{n + 1}: m{n}" for n in range(memories)),
        )
        with common.appliance(text, options.core, 1) as server:
            connections, in_flight, quantity = shape
            command = common.bench(
                *("load", "--address", server.address, "--connections", connections),
                *("--in-flight", in_flight, "--quantity", quantity),
            )
            result = common.load(command, options.seconds, options.other, server)
        return {"rate": result["rate"], "cost": result["server_us"]}

    return turn


def poller_turn(options: argparse.Namespace, script: str) -> Callable[[int], common.Result]:
    """Measures a poller, which has a core; its devices have the other."""

    def turn(number: int) -> common.Result:
        seconds = 2 * options.seconds
        with common.started("devices", common.python("devices.py"), options.other) as devices:
            port = devices.address.rpartition(":")[2]
            command = common.python(script, port, number, 1.0, seconds)
            result = common.outcome(command, seconds + common.TIMEOUT, options.core)
        return {"rate": result["rate"], "cost": result["cpu"] / number * 1e6}

    return turn


def picture(found: Sequence[Growth]) -> str:
    """The costs of one, compared with the first row, over the numbers; both logarithmic."""
    width, height, left, top = 640, 360, 50, 20
    most = max(max(each.numbers) for each in found)
    low, high = -3.0, 2.0  # Powers of two of the cost.

    def at(number: int, cost: float) -> str:
        x = left + (width - left - 10) * math.log(number) / math.log(most)
        share = (math.log2(cost) - low) / (high - low)
        return f"{x:.0f},{top + (height - top - 40) * (1 - min(max(share, 0), 1)):.0f}"

    lines = []
    colours = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
    for index, each in enumerate(found):
        points = " ".join(map(at, each.numbers, each.costs()))
        colour = colours[index % len(colours)]
        lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}"/>')
        line = height + 20 + 18 * index
        lines.append(f'<text x="{left}" y="{line}" fill="{colour}">{each.of}</text>')
    for power in range(int(low), int(high) + 1):
        _, _, y = at(1, 2.0**power).partition(",")
        lines.append(f'<text x="5" y="{y}">{2.0**power:g}</text>')
        lines.append(f'<path d="M{left} {y}H{width - 10}" stroke="#ccc"/>')
    for power in range(int(math.log10(most)) + 1):
        x = at(10**power, 1).partition(",")[0]
        lines.append(f'<text x="{x}" y="{height - 20}">{10**power:,}</text>')
    body = "\n".join(lines)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" '
        f'height="{height + 30 + 18 * len(found)}" font-family="sans-serif" font-size="12">\n'
        f'<rect width="100%" height="100%" fill="#fff"/>\n{body}\n</svg>\n'
    )


if __name__ == "__main__":
    main()
