"""`holdfast reload`: has a running appliance reread its configuration."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from holdfast.appliance.control import RELOAD_TIMEOUT_S, NotRunning, ask
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import config_argument
from holdfast.cli.terminal_text import plain


@click.command(epilog="Example: holdfast reload plant.yaml")
@config_argument
def reload(file: Path) -> None:
    """Have the appliance that runs FILE on this machine reread it.

    The whole configuration and all files that it names are checked first. If anything is wrong, the
    appliance goes on as before, and every problem is printed. Warnings are those of `holdfast
    check`.

    Exit codes: 0 reloaded, 1 no appliance of this user runs FILE, or it does not answer, 2 refused,
    3 an internal error: restart the appliance.
    """
    try:
        answer = ask(file, "reload", within_s=RELOAD_TIMEOUT_S)
    except NotRunning as error:
        fail(error)
    if "incomplete" in answer:
        click.echo(plain(answer["incomplete"]), err=True)
        click.echo("A part of the configuration has changed. Restart the appliance.", err=True)
        sys.exit(ExitCode.ATTENTION)
    problems = answer.get("problems") or [answer[key] for key in ("error",) if key in answer]
    if problems:
        for problem in problems:
            click.echo(plain(problem), err=True)
        click.echo("Nothing has changed.", err=True)
        sys.exit(ExitCode.WRONG)
    # An appliance of an earlier version only logs its warnings.
    for warning in answer.get("warnings", ()):
        click.echo(f"warning: {plain(warning)}", err=True)
    changed = [plain(key) for key in answer["changed"]]
    click.echo(f"Reloaded: {', '.join(changed)}" if changed else "Reloaded: nothing has changed")
