"""The option `--log`: one of the logs of a configuration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from holdfast.cli.options.option import option, require_known
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from holdfast.config import Config

log_option = option("--log name", "NAME", "Required if there are several.")


def chosen_log(config: Config, name: str | None) -> str:
    """The log of that name, or the only one. Raises `click.UsageError`."""
    if name is None and len(config.logs) == 1:
        return next(iter(config.logs))
    if name is None:
        known = listing(config.logs) or "none, there are no logs"
        raise click.UsageError(f"--log is missing, allowed: {known}.")
    require_known(name, config.logs, "there is no log", "logs")
    return name
