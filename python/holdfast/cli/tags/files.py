"""The tags of a command that files have: tag lists, devices and profiles of configurations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options.option import require_known
from holdfast.cli.tags.selection import TaggedDevice
from holdfast.cli.terminal_text import show_problems
from holdfast.config import ConfigError
from holdfast.config.tag_files.read import load_tags

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.tags import TagList

CONFIGURATION = ("memories", "listeners", "profiles", "devices")
"""Keys of a configuration that no tag list has."""


def configured(file: Path, name: str, unit: int, timeout: float) -> TaggedDevice:
    """A device of a configuration. Exits for an invalid file."""
    # An appliance takes long to import.
    from holdfast.cli.configuration import load_or_exit

    config = load_or_exit(file)
    require_known(name, config.devices, f"{file} has no device", "devices")
    settings, tags = config.devices[name], config.tags(name)
    if not len(tags):
        raise click.UsageError(f"{file}: device {name} has no tags.")
    source = click.get_current_context().get_parameter_source
    return TaggedDevice(
        settings.url,
        settings.unit if source("unit") is ParameterSource.DEFAULT else unit,
        settings.timeout if source("timeout") is ParameterSource.DEFAULT else timeout,
        tags,
    )


def tags_of(file: Path, profile: str | None) -> TagList:
    """The tags of a list, or of a profile of a configuration; prints problems and exits with 2."""
    if profile is None:
        try:
            return load_tags(file)
        except ConfigError as error:
            if any(problem.key in CONFIGURATION for problem in error.problems):
                raise click.UsageError(
                    f"{file} is a configuration, not a tag list: add --profile NAME for the tags "
                    f"of a profile; or, for a device, give its name in place of URL, and "
                    f"--config {file} in place of --tags."
                ) from None
            show_problems(error)
            raise SystemExit(ExitCode.WRONG) from None
    from holdfast.cli.configuration import load_or_exit

    config = load_or_exit(file)
    require_known(profile, config.profiles, f"{file} has no profile", "profiles")
    return config.profiles[profile].tag_list
