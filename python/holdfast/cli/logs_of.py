"""The log of a configuration that a command is for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from holdfast.runtime.text import guess, listing

if TYPE_CHECKING:
    from holdfast.config import Config


def chosen_log(config: Config, name: str | None) -> str:
    """The log of that name, or the only one. Raises `click.UsageError`."""
    if name is None and len(config.logs) == 1:
        return next(iter(config.logs))
    known = listing(config.logs) or "none, there are no logs"
    if name is None:
        raise click.UsageError(f"--log is missing, allowed: {known}.")
    if name not in config.logs:
        near = guess(name, config.logs) or "."
        raise click.UsageError(f"there is no log {name!r}, allowed: {known}{near}")
    return name
