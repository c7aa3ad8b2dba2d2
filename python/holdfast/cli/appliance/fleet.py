"""`holdfast fleet`: the scanners that share devices, and how to end one without a gap."""

from __future__ import annotations

import asyncio
import sys
import time
from typing import Any

import click

from holdfast.cli import SuggestingGroup
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.nats import nats_options
from holdfast.cli.options.option import flag, json_option, option, parsed_by
from holdfast.cli.terminal_text import counted, print_json, table
from holdfast.config.values.scanner_settings import PREFIX, parse_fleet, parse_member
from holdfast.net import event_loop
from holdfast.net.nats.connection import Servers
from holdfast.scanner.fleet.observer import FleetObserver, FleetUnavailable

_HEAD = (
    *("node", "state", "partitions", "devices", "tags", "refused", "scans/s", "missed"),
    "version",
)
_SAMPLE_INTERVAL_S = 1.0
"""Between two samples, from which rates are calculated."""


@click.group(cls=SuggestingGroup, epilog="Example: holdfast fleet status plant")
def fleet() -> None:
    """Show and drain the scanners of a fleet."""


@fleet.command(epilog="Example: holdfast fleet status plant --watch")
@click.argument("fleet", type=parsed_by(parse_fleet), metavar="NAME")
@nats_options
@json_option
@flag("--watch", "Print anew every second, until Ctrl-C.")
def status(fleet: str, servers: Servers, as_json: bool, watch: bool) -> None:
    """Show the nodes of the fleet NAME, and what each of them does.

    Exit codes: 0 every partition has a node, 1 NATS can't be reached or has no such fleet, 3 there
    is no live node, a partition has none, or a node refuses a device.
    """
    try:
        is_well = event_loop.run(_status(fleet, servers, as_json, watch))
    except (FleetUnavailable, OSError) as error:
        fail(error, reason="connection")
    except KeyboardInterrupt:
        if watch:
            return
        raise
    if not is_well:
        sys.exit(ExitCode.ATTENTION)


async def _status(name: str, servers: Servers, as_json: bool, watch: bool) -> bool:
    async with FleetObserver(name, servers) as observer:
        before, at = await observer.look(), time.monotonic()
        while True:
            await asyncio.sleep(_SAMPLE_INTERVAL_S)
            now, seconds = await observer.look(), time.monotonic() - at
            shown = now.to_json(before, seconds)
            if as_json:
                seen = {key: value for key, value in shown.items() if key != "fleet"}
                print_json({"ok": True, "target": name, **seen})
            else:
                click.echo("\n".join(_lines(shown)))
            before, at = now, time.monotonic()
            if not watch:
                nodes = shown["nodes"]
                refused = sum(node["refused"] for node in nodes)
                return bool(nodes) and not (shown["free_partitions"] or refused)


def _lines(shown: dict[str, Any]) -> list[str]:
    if not shown["nodes"]:
        return [f"fleet {shown['fleet']}: no live node"]
    nodes = [{**node, "scans/s": f"{node['scans_per_second']:.1f}"} for node in shown["nodes"]]
    rows = [[str(node[name]) for name in _HEAD] for node in nodes]
    free = shown["free_partitions"]
    lines = [
        f"fleet {shown['fleet']}: {counted(len(rows), 'node')}, {shown['partitions']} partitions"
        + (f", {free} of them without a node" if free else "")
    ]
    return [*lines, *(f"  {line}" for line in table(_HEAD, rows))]


@fleet.command(epilog="Example: holdfast fleet drain plant scan-a")
@click.argument("name", type=parsed_by(parse_fleet))
@click.argument("node", type=parsed_by(parse_member))
@option("--prefix", "SUBJECT", "First part of all subjects.", default=PREFIX)
@nats_options
def drain(name: str, node: str, prefix: str, servers: Servers) -> None:
    """Make NODE of the fleet NAME hand over its devices to the other nodes, and exit.

    Returns when the node has left. Exit codes: 0 it has left, 1 NATS or the node can't be reached,
    or the node did not leave.
    """
    try:
        event_loop.run(_drain(name, node, prefix, servers))
    except (FleetUnavailable, OSError) as error:
        fail(error)
    click.echo(f"{node} has left the fleet {name}.")


async def _drain(name: str, node: str, prefix: str, servers: Servers) -> None:
    async with FleetObserver(name, servers) as observer:
        await observer.drain(node, prefix)
