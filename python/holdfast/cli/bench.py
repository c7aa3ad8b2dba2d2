"""`holdfast bench`: measures the throughput and latency of a Modbus server."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, places, showing
from holdfast.cli.progress import bar
from holdfast.errors import ModbusError
from holdfast.protocol import LAST_ADDRESS, READ_BITS
from holdfast.tools.load import MAX_CONNECTIONS, Load

if TYPE_CHECKING:
    from holdfast.types import Area

QUANTILES = {"p50": 0.5, "p90": 0.9, "p99": 0.99}
BAR = 40


def _area(text: str) -> Area:
    return places.area_of(text)


@click.command(
    epilog="Example: holdfast bench tcp://127.0.0.1:5020 --connections 4 --in-flight 8 --seconds 10"
)
@device.url_argument
@click.option(
    "--connections",
    type=click.IntRange(1, MAX_CONNECTIONS),
    default=1,
    show_default=True,
    metavar="N",
    help="Number of concurrent connections.",
)
@click.option(
    "--in-flight",
    type=click.IntRange(1, 1024),
    default=1,
    show_default=True,
    metavar="N",
    help="Requests in flight on each connection.",
)
@click.option(
    "--seconds",
    type=device.seconds,
    default="5",
    show_default=True,
    metavar="SECONDS",
    help="Duration of the test.",
)
@click.option(
    "--area",
    type=_area,
    default="holding_registers",
    show_default=True,
    metavar="AREA",
    help="Area to read.",
)
@click.option(
    "--address",
    type=click.IntRange(0, LAST_ADDRESS),
    default=0,
    show_default=True,
    metavar="N",
    help="First address to read.",
)
@click.option(
    "--count",
    type=click.IntRange(1, READ_BITS),
    default=10,
    show_default=True,
    metavar="N",
    help="Bits or registers per request.",
)
@device.device_options
@device.json_option
def bench(
    url: str,
    connections: int,
    in_flight: int,
    seconds: float,
    area: Area,
    address: int,
    count: int,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Measure how many reads per second the Modbus server at URL answers, and how fast.

    WARNING: THIS IS A LOAD TEST. It sends as many requests as the device can answer. The device may
    neglect its other work, drop other clients or stop. Never run it against a device that controls
    a process.

    Every connection reads the same range repeatedly. The client is a single thread and reaches its
    own limit at some tens of thousands of requests per second.

    Ctrl-C ends the test early and prints the results so far. Exit codes: 0 done, 1 no answer, 2
    wrong usage.
    """
    with device.usable():
        load = Load(
            url,
            area,
            address,
            count,
            unit=unit,
            connections=connections,
            in_flight=in_flight,
            seconds=seconds,
            timeout=timeout,
        )
    told: dict[str, object] = {
        "url": url,
        "unit": unit,
        "area": area,
        "address": address,
        "count": count,
        "connections": connections,
        "in_flight": in_flight,
    }
    try:
        with (
            contextlib.suppress(KeyboardInterrupt),
            bar("Loading", math.ceil(10 * seconds), lambda: f"{load.rate:.0f} /s") as advance,
        ):
            asyncio.run(load.run(advance and (lambda load: advance(int(10 * load.elapsed)))))
    except ModbusError as error:
        device.fail(error, url, told if as_json else None)
    answered = load.latencies.count > 0
    if as_json:
        click.echo(json.dumps({"ok": answered, **told, **_told(load)}, indent=2))
    else:
        what = f"{area} {address} to {address + count - 1}"
        how = f"{showing.counted(connections, 'connection')}, {in_flight} in flight on each"
        click.echo(f"{url}, unit {unit}: {what}, {how}, {load.elapsed:.1f} s\n")
        click.echo("\n".join(_lines(load)))
    if not answered:
        sys.exit(device.FAILED)


def _lines(load: Load) -> list[str]:
    """The results as text."""
    times = load.latencies
    rows = [("requests", f"{times.count}"), ("rate", f"{load.rate:.0f} /s")]
    if times.count:
        rows += [(name, _time(times.quantile(share))) for name, share in QUANTILES.items()]
        rows.append(("max", _time(times.most)))
    rows += [("errors", "none")] if not load.errors else []
    lines = [f"{name:9} {text:>12}" for name, text in rows]
    for kind, number in load.errors.most_common():
        lines.append(f"{'errors':9} {number:>12}  {showing.styled(kind, fg='red')}")
    return [*lines, *_histogram(load)]


def _histogram(load: Load) -> list[str]:
    bars = load.latencies.histogram()
    if not bars:
        return []
    block = "█" if showing.fits("█") else "#"
    highest = max(number for _, _, number in bars)
    lines = [""]
    for _, end, number in bars:
        share = number / load.latencies.count
        bar = showing.styled(block * max(number > 0, round(BAR * number / highest)), fg="green")
        filled = bar + " " * (BAR - len(click.unstyle(bar)))
        lines.append(f"under {_time(end):>9}  {filled}  {100 * share:5.1f} %  {number:>9}")
    return lines


def _time(seconds: float) -> str:
    if seconds == math.inf:
        return "∞" if showing.fits("∞") else "inf"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} {'µs' if showing.fits('µ') else 'us'}"


def _told(load: Load) -> dict[str, object]:
    """The results for JSON."""
    times = load.latencies
    latency = {name: times.quantile(share) for name, share in QUANTILES.items()}
    latency |= {"mean": times.mean, "min": times.least if times.count else 0.0, "max": times.most}
    return {
        "seconds": round(load.elapsed, 3),
        "requests": times.count,
        "rate": round(load.rate, 1),
        "latency_ms": {name: round(seconds * 1e3, 4) for name, seconds in latency.items()},
        "errors": dict(load.errors),
        "histogram": [
            {"below_ms": None if end == math.inf else round(end * 1e3, 6), "requests": number}
            for _, end, number in times.histogram()
        ],
    }
