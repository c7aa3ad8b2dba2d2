"""The command-line options for the format of the log."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar, get_args

import click

from holdfast.logs import Format

if TYPE_CHECKING:
    from collections.abc import Callable

Command = TypeVar("Command", bound="Callable[..., Any]")

FORMATS = click.Choice(get_args(Format))


def log_options(command: Command) -> Command:
    """Adds `--log-format`, and `--json-log` for `--log-format json`."""
    form = click.option(
        "--log-format",
        type=FORMATS,
        default="text",
        show_default=True,
        help="ecs: JSON in the names of the Elastic Common Schema.",
    )
    json_log = click.option("--json-log", is_flag=True, help="The same as --log-format json.")
    return form(json_log(command))


def log_config(log_format: Format, json_log: bool) -> dict[str, str]:
    """The options as in a configuration. Raises `click.UsageError`."""
    if json_log and log_format == "ecs":
        raise click.UsageError("--json-log and --log-format ecs can't be used together.")
    return {"format": "json" if json_log else log_format}
