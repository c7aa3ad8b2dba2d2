"""Loading a configuration for a command: as it should be, or not at all."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from holdfast.config import Config, ConfigError, load

if TYPE_CHECKING:
    from pathlib import Path

WRONG = 2
"""The exit code for wrong usage or a wrong configuration."""


def load_or_exit(path: Path | str) -> Config:
    """The configuration; when it is wrong, prints every problem and exits with 2.

    What is right but has no effect is told on standard error, as a warning.
    """
    try:
        config = load(path)
    except ConfigError as error:
        show_problems(error)
        sys.exit(WRONG)
    for warning in config.warnings:
        click.echo(f"warning: {warning}", err=True)
    return config


def show_problems(error: ConfigError) -> None:
    """Prints every problem on a line of standard error, and how many there are."""
    for problem in error.problems:
        click.echo(str(problem), err=True)
    count = len(error.problems)
    click.echo("1 problem" if count == 1 else f"{count} problems", err=True)
