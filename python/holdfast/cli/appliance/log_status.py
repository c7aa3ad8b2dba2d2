"""`holdfast log status`: the logs of a running appliance, and the nodes that share them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from holdfast.appliance.control import NotRunning, ask
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import config_argument, json_option
from holdfast.cli.terminal_text import plain, print_json, table
from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Iterator

_HEAD = ("node", "last message", "at", "digest of", "digest")
_DEVICES = ("device", "polled by")
_DIGEST = 12
"""Characters of a digest that are shown."""


@click.command("status", epilog="Example: holdfast log status plant.yaml")
@config_argument
@json_option
def log_status(file: Path, as_json: bool) -> None:
    """Show the logs of the appliance that runs FILE on this machine, and the nodes in them.

    Exit codes: 0 all logs are well, 1 no appliance of this user runs FILE, 3 a log is not
    connected, has failed or had no contact within max_lag, nodes have different contents, or no
    node polls a device.
    """
    try:
        found = ask(file, "replicas")["logs"]
    except NotRunning as error:
        fail(error, reason="connection")
    if as_json:
        print_json({"ok": True, "target": str(file), "logs": found}, indent=2)
    elif not found:
        click.echo("no memory is replicated")
    else:
        for name, status in found.items():
            click.echo("\n".join(_shown(name, status)))
    if not all(_is_well(status) for status in found.values()):
        sys.exit(ExitCode.ATTENTION)


def _is_well(status: dict[str, Any]) -> bool:
    differs = status["digest"] is not None and status["digest"][2] is False
    unpolled = any(device.get("reason") for device in status["devices"].values())
    return status["obstacle"] is None and not differs and not unpolled


def _shown(name: str, status: dict[str, Any]) -> list[str]:
    where = f"connected to {plain(status['server'])}" if status["connected"] else "not connected"
    contact = status["contact_age"]
    lines = [
        f"log {name}: {status['phase']}, {where}, replicas {status['replicas']}",
        f"  sequence {status['sequence']}, {status['lag']} behind the last known, "
        + ("no contact yet" if contact is None else f"contact {contact:.1f} s ago"),
        f"  writes of this node: {status['steps']} done, {status['unavailable']} not sent, "
        f"{status['not_confirmed']} not confirmed",
    ]
    if (server := status["embedded"]) is not None:
        state = "running" if server["running"] else "not running"
        lines.append(f"  embedded server: {state}, started again {server['restarts']} times")
    if status["failure"] is not None:
        lines.append(f"  failed: {plain(status['failure'][1])}")
    elif status["obstacle"] is not None:
        lines.append(f"  not caught up: {plain(status['obstacle'])}")
        if status["last_error"] is not None:
            lines.append(f"  last error: {plain(status['last_error'])}")
    rows = (_row(node, status) for node in status["nodes"])
    lines += (f"  {line}" for line in table(_HEAD, rows))
    if devices := status["devices"]:
        rows = (row for device in devices.items() for row in _polled(*device))
        lines += (f"  {line}" for line in table(_DEVICES, rows))
    return lines


def _polled(device: str, found: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield plain(device), "nobody" if found["node"] is None else plain(found["node"])
    if (reason := found.get("reason")) is not None:
        yield "", plain(reason)


def _row(node: dict[str, Any], status: dict[str, Any]) -> tuple[str, ...]:
    # `nodes` has the digests of other nodes only.
    own = node["name"] == status["node"]
    at, digest, *_ = (status if own else node)["digest"] or ("", "")
    when = log_lines.timestamp(node["time_ns"] / 1e9)
    return plain(node["name"]), str(node["sequence"]), when, str(at), digest[:_DIGEST]
