"""The exit codes of all commands, and the error that ends a command."""

from __future__ import annotations

import sys
from enum import IntEnum
from typing import NoReturn

import click

from holdfast.cli import answers


class ExitCode(IntEnum):
    """How a command has ended. docs/cli.md lists the codes with these meanings."""

    SUCCESS = 0
    FAILED = 1
    WRONG = 2
    ATTENTION = 3


MEANINGS = {
    ExitCode.SUCCESS: "Done, or ended by a signal if it runs until then, as `watch` does.",
    ExitCode.FAILED: "The command failed: no answer, a refusal, or a search that ended early.",
    ExitCode.WRONG: "Wrong usage, or a configuration or file with errors. Nothing was done.",
    ExitCode.ATTENTION: "The command worked, and found a state that somebody must look at.",
}


def fail(
    message: object,
    code: ExitCode = ExitCode.FAILED,
    *,
    reason: str = "failed",
    target: object = None,
    is_printed: bool = False,
    prefix: str = "holdfast: ",
) -> NoReturn:
    """Prints an error, unless it is printed already as part of JSON, and exits."""
    if answers.wanted() and not is_printed:
        answers.print_wrong(reason, message, target)
    elif not is_printed:
        click.echo(f"{prefix}{message}", err=True)
    sys.exit(code)
