"""`holdfast import`: converts the configuration of another program."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli import SuggestingGroup
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.duration import Duration, time_option
from holdfast.cli.options.item import areas_of
from holdfast.cli.options.option import config_argument, flag, json_option, option, option_group
from holdfast.cli.options.url import checked_url
from holdfast.cli.shell_command import shell_command
from holdfast.cli.terminal_text import (
    counted,
    print_json,
    print_problems,
    problems_to_json,
    show_problems,
)
from holdfast.client.base import MAX_INTERVAL_S, MIN_INTERVAL_S
from holdfast.config import ConfigError
from holdfast.importing import (
    INTERVAL_S,
    ORDINALS,
    NotImportable,
    read_home_assistant,
    read_mma,
    read_modbus_proxy,
    read_modpoll,
    read_replicator,
    read_telegraf,
)
from holdfast.runtime import whole_files

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.importing import Imported
    from holdfast.types import Area


@dataclass(frozen=True)
class _Task:
    """What all imports have: the file to convert, and where the result goes."""

    file: Path
    output: Path | None
    force: bool
    as_json: bool

    def convert(self, read: Callable[[Path], Imported]) -> None:
        """Converts the file, and writes or prints the result."""
        if self.output is not None and _same(self.file, self.output):
            raise click.UsageError("OUT and FILE are the same file.")
        try:
            imported = read(self.file)
        except ConfigError as error:
            _refuse(error, self.as_json)
        if self.output is not None:
            _write(self.output, imported.to_yaml(), self.force)
        if self.as_json:
            print_json(_answer(imported), indent=2)
            return
        if self.output is None:
            click.echo(imported.to_yaml(), nl=False)
        for note in imported.notes:
            click.echo(str(note), err=True)
        click.echo(_summary(imported, self.output), err=True)


_task = option_group(
    config_argument,
    option("--output", "OUT", "Write the YAML to this file.", click.Path(path_type=Path)),
    flag("--force", "Replace OUT if it exists."),
    json_option,
    into=("task", _Task),
)
"""Adds the argument and the options of all imports: the argument `task`."""


class _Programs(SuggestingGroup):
    page = "docs/replacing.md, which has tables for other programs"


@click.group(
    "import",
    cls=_Programs,
    epilog="Example: holdfast import mma config.yaml --output plant.yaml",
)
def import_() -> None:
    """Convert the configuration of another program."""


@import_.command(epilog="Example: holdfast import mma config.yaml --output plant.yaml")
@_task
@flag(
    "--as-it-was-meant/--as-it-ran as_meant",
    "Convert keys that the source ignored as documented, or as they ran. Default: as it ran.",
)
@flag("--keep-published-tokens", "Keep REST tokens that are in the documentation of the source.")
@option(
    "--grant-rest",
    "AREA,...",
    "Areas that REST may write too, such as hr.",
    areas_of,
)
@option("--grant-mqtt", "AREA,...", "The same for MQTT.", areas_of)
def mma(
    task: _Task,
    as_meant: bool,
    keep_published_tokens: bool,
    grant_rest: tuple[Area, ...] | None,
    grant_mqtt: tuple[Area, ...] | None,
) -> None:
    """Convert FILE, a configuration of the Modbus Memory Appliance, to a Holdfast configuration.

    Prints the new configuration. Notes on standard error, and comments in the configuration, say
    what was not converted, what was changed and what to check. Exit codes: 0 done, 1 can't write
    OUT, 2 can't import FILE.
    """
    task.convert(
        partial(
            read_mma,
            as_meant=as_meant,
            keep_published_tokens=keep_published_tokens,
            grant_rest=grant_rest or (),
            grant_mqtt=grant_mqtt or (),
        )
    )


@import_.command(
    epilog="Example: holdfast import modpoll boiler.csv --url tcp://10.0.0.5 --output plant.yaml"
)
@_task
@option(
    "--url",
    "URL",
    "The devices, as --tcp, --udp or --rtu of modpoll name them.",
    checked_url,
    required=True,
)
@time_option(
    "--interval",
    "Time between polls, as --rate of modpoll.",
    f"{INTERVAL_S:g}",
    Duration(MIN_INTERVAL_S, MAX_INTERVAL_S),
)
def modpoll(task: _Task, url: str, interval: float) -> None:
    """Convert FILE, a CSV file of the Python program modpoll, to a Holdfast configuration.

    Prints the new configuration. Notes on standard error, and comments in the configuration, say
    what was not converted, what was changed and what to check. Exit codes: 0 done, 1 can't write
    OUT, 2 can't import FILE.
    """
    task.convert(lambda file: read_modpoll(file, url, interval))


@import_.command(
    "modbus-proxy", epilog="Example: holdfast import modbus-proxy devices.yaml --output plant.yaml"
)
@_task
def modbus_proxy(task: _Task) -> None:
    """Convert FILE, a configuration of modbus-proxy, to a Holdfast configuration.

    FILE is YAML, JSON or TOML. Prints the new configuration, with a link and a listener for each
    device. Notes on standard error, and comments in the configuration, say what was not converted,
    what was changed and what to check. Exit codes: 0 done, 1 can't write OUT, 2 can't import FILE.
    """
    task.convert(read_modbus_proxy)


@import_.command(epilog="Example: holdfast import replicator replicator.yaml --output mirror.yaml")
@_task
def replicator(task: _Task) -> None:
    """Convert FILE, a configuration of the Modbus Replicator, to a Holdfast configuration.

    Prints the new configuration. Notes on standard error, and comments in the configuration, say
    what was not converted, what was changed and what to check. Exit codes: 0 done, 1 can't write
    OUT, 2 can't import FILE.
    """
    task.convert(read_replicator)


@import_.command(
    "home-assistant",
    epilog="Example: holdfast import home-assistant configuration.yaml --output plant.yaml",
)
@_task
def home_assistant(task: _Task) -> None:
    """Convert the modbus section of FILE, of Home Assistant, to a Holdfast configuration.

    FILE can also contain only that section. Prints the new configuration: its devices appear in
    Home Assistant over MQTT. Notes on standard error, and comments in the configuration, say what
    was not converted, what was changed and what to check. Exit codes: 0 done, 1 can't write OUT,
    2 can't import FILE.
    """
    task.convert(read_home_assistant)


@import_.command(epilog="Example: holdfast import telegraf telegraf.conf --output plant.yaml")
@_task
def telegraf(task: _Task) -> None:
    """Convert the Modbus inputs of FILE, of Telegraf, to a Holdfast configuration.

    Prints the new configuration, with its first outputs.influxdb_v2. Notes on standard error, and
    comments in the configuration, say what was not converted, what was changed and what to check.
    Exit codes: 0 done, 1 can't write OUT, 2 can't import FILE.
    """
    task.convert(read_telegraf)


def _refuse(error: ConfigError, as_json: bool) -> None:
    """Prints why the import is impossible, and exits with 2."""
    notes = error.notes if isinstance(error, NotImportable) else ()
    if as_json:
        print_problems(error, notes=problems_to_json(notes))
    else:
        for note in notes:
            click.echo(str(note), err=True)
        show_problems(error)
    sys.exit(ExitCode.WRONG)


def _write(output: Path, text: str, force: bool) -> None:
    try:
        if force:
            whole_files.replace(output, text.encode())
        else:
            whole_files.write_new({output: (text.encode(), whole_files.USUAL)})
    except FileExistsError:
        fail(f"{output}: already exists; --force overwrites it", reason="file", prefix="")
    except OSError as error:
        why = f"can't be written: {error.strerror or error}"
        fail(f"{output}: {why}", reason="file", prefix="")


def _same(file: Path, output: Path) -> bool:
    try:
        return file.samefile(output)
    except OSError:
        return False


def _summary(imported: Imported, output: Path | None) -> str:
    of = ""
    if imported.generation is not None:
        of = f" is of the {ORDINALS[imported.generation]} generation"
    notes = counted(len(imported.notes), "note")
    check = f"; next: {shell_command('holdfast', 'check', output)}" if output is not None else ""
    return f"{imported.file}{of}: {notes}{check}"


def _answer(imported: Imported) -> dict[str, object]:
    answer: dict[str, object] = {"ok": True, "target": imported.file, "problems": []}
    if imported.generation is not None:
        answer["generation"] = imported.generation
    return {**answer, "notes": problems_to_json(imported.notes), "config": imported.data}
