"""`holdfast fleet`: the scanners that share devices, and how to end one without a gap."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli.scan import DEFAULT_URL, member, server_urls
from holdfast.cli.showing import counted, table
from holdfast.cli.suggesting import SuggestingGroup
from holdfast.cli.tls_options import tls_of, tls_options
from holdfast.config.scanning import PREFIX
from holdfast.net import event_loop
from holdfast.scanner import Servers
from holdfast.scanner.fleet.observer import FleetObserver, FleetUnavailable

if TYPE_CHECKING:
    from collections.abc import Callable

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FAILED = 1
NOT_WELL = 3

_HEAD = ("node", "state", "partitions", "devices", "tags", "scans/s", "missed", "version")
_BETWEEN = 1.0
"""Seconds between two looks, from which rates are calculated."""


@click.group(cls=SuggestingGroup, epilog="Example: holdfast fleet status plant")
def fleet() -> None:
    """Show and drain the scanners of a fleet."""


def _nats(command: Callable[..., None]) -> Callable[..., None]:
    """Adds the options of the connection to NATS."""
    for option in (
        click.option(
            "--nats",
            multiple=True,
            type=server_urls,
            metavar="URL",
            help=f"NATS server; repeatable. [env: NATS_SERVERS; default: {DEFAULT_URL}]",
        ),
        click.option("--user", metavar="NAME", help="User name for the NATS server."),
        click.option("--password-file", type=FILE, metavar="FILE", help="File with the password."),
        click.option("--token-file", type=FILE, metavar="FILE", help="File with a token."),
        click.option("--creds", type=FILE, metavar="FILE", help="File with a user's JWT and seed."),
        tls_options("tls", "Trusted authorities for the NATS server."),
    ):
        command = option(command)
    return command


def _servers(options: dict[str, Any]) -> Servers:
    urls = [url for each in options["nats"] for url in each]
    urls = urls or server_urls(os.environ.get("NATS_SERVERS", ""))
    return Servers(
        tuple(urls) or (DEFAULT_URL,),
        options["user"],
        options["password_file"],
        options["token_file"],
        options["creds"],
        tls_of("tls", *(options[f"tls_{key}"] for key in ("ca", "cert", "key"))),
    )


@fleet.command(epilog="Example: holdfast fleet status plant --watch")
@click.argument("name", type=member)
@_nats
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs.")
@click.option("--watch", is_flag=True, help="Print anew every second, until Ctrl-C.")
def status(name: str, as_json: bool, watch: bool, **options: Any) -> None:
    """Show the nodes of the fleet NAME, and what each of them does.

    Exit codes: 0 every partition has a node, 1 NATS can't be reached, 3 there is no live node, or
    a partition has none.
    """
    try:
        is_well = event_loop.run(_status(name, _servers(options), as_json, watch))
    except (FleetUnavailable, OSError) as error:
        click.echo(f"holdfast: {error}", err=True)
        sys.exit(FAILED)
    except KeyboardInterrupt:
        return
    if not is_well:
        sys.exit(NOT_WELL)


async def _status(name: str, servers: Servers, as_json: bool, watch: bool) -> bool:
    async with FleetObserver(name, servers) as looker:
        before, at = await looker.look(), time.monotonic()
        while True:
            await asyncio.sleep(_BETWEEN)
            now, seconds = await looker.look(), time.monotonic() - at
            shown = now.shown(before, seconds)
            if as_json:
                click.echo(json.dumps(shown))
            else:
                click.echo("\n".join(_lines(shown)))
            before, at = now, time.monotonic()
            if not watch:
                return bool(shown["nodes"]) and not shown["free_partitions"]


def _lines(shown: dict[str, Any]) -> list[str]:
    if not shown["nodes"]:
        return [f"fleet {shown['fleet']}: no live node"]
    rows = [
        (
            node["node"],
            node["state"],
            str(node["partitions"]),
            str(node["devices"]),
            str(node["tags"]),
            f"{node['scans_per_second']:.1f}",
            str(node["missed"]),
            node["version"],
        )
        for node in shown["nodes"]
    ]
    free = shown["free_partitions"]
    lines = [
        f"fleet {shown['fleet']}: {counted(len(rows), 'node')}, {shown['partitions']} partitions"
        + (f", {free} of them without a node" if free else "")
    ]
    return [*lines, *(f"  {line}" for line in table(_HEAD, rows))]


@fleet.command(epilog="Example: holdfast fleet drain plant scan-a")
@click.argument("name", type=member)
@click.argument("node", type=member)
@click.option("--prefix", default=PREFIX, show_default=True, help="First part of all subjects.")
@_nats
def drain(name: str, node: str, prefix: str, **options: Any) -> None:
    """Have NODE of the fleet NAME hand its devices over to the other nodes, and end.

    Returns when the node has left. Exit codes: 0 it has left, 1 there is no such node, or it did
    not leave.
    """
    try:
        event_loop.run(_drain(name, node, prefix, _servers(options)))
    except (FleetUnavailable, OSError) as error:
        click.echo(f"holdfast: {error}", err=True)
        sys.exit(FAILED)
    click.echo(f"{node} has left the fleet {name}.")


async def _drain(name: str, node: str, prefix: str, servers: Servers) -> None:
    async with FleetObserver(name, servers) as looker:
        await looker.drain(node, prefix)
