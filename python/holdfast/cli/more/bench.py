"""`holdfast bench`: measures the throughput and latency of a Modbus server."""

from __future__ import annotations

import asyncio
import contextlib
import math
import sys
from dataclasses import asdict

import click

from holdfast.cli import device_errors, terminal_text
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options import device, item
from holdfast.cli.options.duration import time_option, timeout_option
from holdfast.cli.options.item import words_argument
from holdfast.cli.options.option import json_option, number_option
from holdfast.cli.options.url import url_argument
from holdfast.cli.progress import bar
from holdfast.cli.terminal_text import print_json
from holdfast.client.load import MAX_CONNECTIONS, Load
from holdfast.errors import ModbusError

QUANTILES = {"p50": 0.5, "p90": 0.9, "p99": 0.99}
BAR_COLUMNS = 40
COUNT = 10
"""Registers per request by default, if so many exist."""


@click.command(epilog="Example: holdfast bench tcp://127.0.0.1:5020 --connections 4 --in-flight 8")
@url_argument
@words_argument(item.RANGE)
@number_option("--connections", "Number of concurrent connections.", 1, MAX_CONNECTIONS, 1)
@number_option("--in-flight", "Requests in flight on each connection.", 1, 1024, 1)
@time_option("--duration", "Duration of the test.", "5")
@device.unit_option()
@timeout_option()
@json_option
def bench(
    url: str,
    words: tuple[str, ...],
    connections: int,
    in_flight: int,
    duration: float,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Measure how many reads per second the Modbus server at URL answers, and how fast.

    WARNING: THIS IS A LOAD TEST. It sends as many requests as the device can answer. The device may
    neglect its other work, drop other clients or stop. Never run it against a device that controls
    a process.

    Every connection reads COUNT addresses from ITEM on, repeatedly. Default: hr:0, and 10
    registers, fewer if they do not exist. The client is a single thread and reaches its own limit
    at some tens of thousands of requests per second.

    Ctrl-C ends the test early and prints the results so far. Exit codes: 0 done, 1 no answer, 2
    wrong usage.
    """
    # An area alone is the one from its first address on.
    words = (words[0], "0") if len(words) == 1 and words[0].isalpha() else words or ("hr", "0")
    place, count = item.single(words)
    asked = {"unit": unit, "connections": connections, "in_flight": in_flight}
    fields: dict[str, object] = {"target": url, **asdict(place), **asked}

    def load_of(count: int) -> Load:
        with device.usable():
            return Load(
                url,
                place.area,
                place.address,
                count,
                seconds=duration,
                timeout=timeout,
                **asked,
            )

    load = load_of(count or 1)
    try:
        with device.connect(url, unit, timeout) as client:
            count = count or device.existing(client, place, COUNT)
        load = load_of(count)
        fields["count"] = count
        with (
            contextlib.suppress(KeyboardInterrupt),
            bar("Loading", math.ceil(10 * duration), lambda: f"{load.rate:.0f} /s") as advance,
        ):
            asyncio.run(load.run(advance and (lambda load: advance(int(10 * load.elapsed)))))
    except ModbusError as error:
        device_errors.fail(error, url, fields)
    answered = load.latencies.count > 0
    if as_json:
        wrong = {} if answered else device_errors.problem(load.error or "no reply")
        print_json({"ok": answered, **fields, **wrong, **_to_json(load)}, indent=2)
    else:
        what = f"{place.area} {place.address} to {place.address + count - 1}"
        how = f"{terminal_text.counted(connections, 'connection')}, {in_flight} in flight on each"
        click.echo(f"{url}, unit {unit}: {what}, {how}, {load.elapsed:.1f} s\n")
        click.echo("\n".join(_lines(load)))
    if not answered:
        sys.exit(ExitCode.FAILED)


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
        lines.append(f"{'errors':9} {number:>12}  {terminal_text.styled(kind, fg='red')}")
    return [*lines, *_histogram(load)]


def _histogram(load: Load) -> list[str]:
    bars = load.latencies.histogram()
    if not bars:
        return []
    block = "█" if terminal_text.fits("█") else "#"
    highest = max(number for _, _, number in bars)
    lines = [""]
    for _, end, number in bars:
        share = number / load.latencies.count
        bar = terminal_text.styled(
            block * max(number > 0, round(BAR_COLUMNS * number / highest)), fg="green"
        )
        filled = bar + " " * (BAR_COLUMNS - len(click.unstyle(bar)))
        lines.append(f"under {_time(end):>9}  {filled}  {100 * share:5.1f} %  {number:>9}")
    return lines


def _time(seconds: float) -> str:
    if seconds == math.inf:
        return "∞" if terminal_text.fits("∞") else "inf"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} {'µs' if terminal_text.fits('µ') else 'us'}"


def _to_json(load: Load) -> dict[str, object]:
    """The results for JSON."""
    times = load.latencies
    latency = {name: times.quantile(share) for name, share in QUANTILES.items()}
    latency |= {"mean": times.mean, "min": times.least, "max": times.most}
    return {
        "seconds": round(load.elapsed, 3),
        "requests": times.count,
        "rate": round(load.rate, 1),
        "latency_ms": {
            name: round(seconds * 1e3, 4) if times.count else None
            for name, seconds in latency.items()
        },
        "errors": dict(load.errors),
        "histogram": [
            {"below_ms": None if end == math.inf else round(end * 1e3, 6), "requests": number}
            for _, end, number in times.histogram()
        ],
    }
