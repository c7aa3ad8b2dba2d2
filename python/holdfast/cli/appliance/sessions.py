"""`holdfast sessions`: lists the open connections of a running appliance, and ends one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from holdfast.adapters.sessions import parse_session_id
from holdfast.appliance.control import NotRunning, ask
from holdfast.cli.exit_codes import fail
from holdfast.cli.options.option import config_argument, json_option, option
from holdfast.cli.terminal_text import plain, print_json, table
from holdfast.events import log_lines

_HEAD = ("id", "peer", "opened", "idle", "role", "subject", "serial")


@click.command(epilog="Example: holdfast sessions plant.yaml --end scada/17")
@config_argument
@json_option
@option("--end ending", "ID", "End the connection with this id.")
def sessions(file: Path, as_json: bool, ending: str | None) -> None:
    """List the open connections of the appliance that runs FILE on this machine.

    A peer whose connection is ended can connect again, unless a rule forbids it. Exit codes: 0
    done, 1 no appliance of this user runs FILE, or no connection has this id.
    """
    try:
        if ending is not None:
            _end(file, ending)
            if as_json:
                print_json({"ok": True, "target": str(file), "ended": ending})
            else:
                click.echo(f"ended {ending}")
            return
        found = ask(file, "sessions")["sessions"]
    except NotRunning as error:
        fail(error, reason="connection")
    if as_json:
        listed = [{"session": _id(each), **each} for each in found]
        print_json({"ok": True, "target": str(file), "sessions": listed}, indent=2)
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
        fail(f"{ending}: no such connection")


def _id(session: dict[str, Any]) -> str:
    """What `--end` takes."""
    return f"{session['listener']}/{session['id']}"


def _row(session: dict[str, Any]) -> tuple[str, ...]:
    return (
        plain(_id(session)),
        plain(session["peer"]),
        log_lines.timestamp(session["opened"]),
        f"{session['idle']:.1f} s",
        *(plain(session.get(key, "")) for key in ("role", "subject", "serial")),
    )
