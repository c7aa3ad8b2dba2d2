"""`holdfast sessions`: lists the open connections of a running appliance, and ends one."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from holdfast import logs
from holdfast.adapters.sessions import parse_session_id
from holdfast.appliance.control import NotRunning, ask
from holdfast.cli.showing import plain, table

_HEAD = ("id", "peer", "opened", "idle", "role", "subject", "serial")


@click.command(epilog="Example: holdfast sessions plant.yaml --end scada/17")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs.")
@click.option("--end", "ending", metavar="ID", help="End the connection with this id.")
def sessions(file: Path, as_json: bool, ending: str | None) -> None:
    """List the open connections of the appliance that runs FILE on this machine.

    A peer whose connection is ended can connect again, unless a rule forbids it. Exit codes: 0
    done, 1 no appliance of this user runs FILE, or no connection has this id.
    """
    try:
        if ending is not None:
            _end(file, ending)
            return
        found = ask(file, "sessions")["sessions"]
    except NotRunning as error:
        click.echo(f"holdfast: {error}", err=True)
        sys.exit(1)
    if as_json:
        click.echo(json.dumps({"sessions": found}, indent=2))
    elif found:
        click.echo("\n".join(table(_HEAD, map(_row, found))))
    else:
        click.echo("no open connections")


def _end(file: Path, ending: str) -> None:
    try:
        listener, number = parse_session_id(ending)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="'--end'") from None
    if not ask(file, "end", listener=listener, id=number).get("ended"):
        click.echo(f"holdfast: {ending}: no such connection", err=True)
        sys.exit(1)
    click.echo(f"ended {ending}")


def _row(session: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"{session['listener']}/{session['id']}",
        session["peer"],
        logs.timestamp(session["opened"]),
        f"{session['idle']:.1f} s",
        *(plain(session.get(key, "")) for key in ("role", "subject", "serial")),
    )
