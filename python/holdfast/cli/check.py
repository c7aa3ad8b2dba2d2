"""`holdfast check`: validates a configuration, and prints it with all defaults."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli.configuration import WRONG, load_or_exit, load_whole
from holdfast.config import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config import Problem


@click.command(epilog="Example: holdfast check plant.yaml")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs.")
def check(file: Path, as_json: bool) -> None:
    """Validate the configuration FILE without starting anything.

    Prints the effective configuration, with all defaults. If FILE is not valid, prints every
    problem with its line and exits with 2.
    """
    if not as_json:
        click.echo(load_or_exit(file).dump(), nl=False)
        return
    try:
        config = load_whole(file)
    except ConfigError as error:
        click.echo(json.dumps({"ok": False, "problems": _plain(error.problems)}, indent=2))
        sys.exit(WRONG)
    answer = {
        "ok": True,
        "problems": [],
        "warnings": _plain(config.warnings),
        "config": config.effective(),
    }
    click.echo(json.dumps(answer, indent=2))


def _plain(problems: Iterable[Problem]) -> list[dict[str, object]]:
    return [dataclasses.asdict(problem) for problem in problems]
