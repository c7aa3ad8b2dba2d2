"""`holdfast memory`: verifies, exports and imports files that keep memories."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli import SuggestingGroup
from holdfast.cli.appliance import memory_file
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import (
    EXISTING_FILE,
    FILE,
    file_option,
    flag,
    json_option,
    option,
)
from holdfast.cli.terminal_text import print_json
from holdfast.config import ConfigError
from holdfast.config.initial_values import parse, read
from holdfast.runtime.text import extent

if TYPE_CHECKING:
    from holdfast.cli.appliance.memory_file import KeptArea
    from holdfast.types import Area


@click.group(cls=SuggestingGroup, epilog="Example: holdfast memory verify setpoints.redb")
def memory() -> None:
    """Verify, export, import and release the contents of files that keep memories.

    A file is in use while the appliance runs: stop it first, or work on a copy.
    """


_of_memory = option("--memory name", "NAME", "Required if there are several.")


@memory.command(epilog="Example: holdfast memory verify setpoints.redb")
@click.argument("file", type=EXISTING_FILE)
@json_option
def verify(file: Path, as_json: bool) -> None:
    """Check every page of FILE, and list its memories. Exit code 2: the file is not usable."""
    found, set_aside = _contents(file), _contents(file, set_aside=True)
    if as_json:
        shown = {"memories": _places(found), "set_aside": _places(set_aside)}
        print_json({"ok": True, "target": str(file), **shown}, indent=2)
        return
    click.echo("intact")
    for name, areas in found.items():
        _show(name, areas)
    for name, areas in set_aside.items():
        _show(f"set aside of {name}", areas)


@memory.command(epilog="Example: holdfast memory export setpoints.redb --output setpoints.csv")
@click.argument("file", type=EXISTING_FILE)
@_of_memory
@file_option("--output", "A .csv, .yaml or .yml file. Default: CSV on standard output.")
@flag("--zeros", "Include values that are 0.")
@flag("--set-aside", "Print the values at addresses that were cut instead.")
def export(file: Path, name: str | None, output: Path | None, zeros: bool, set_aside: bool) -> None:
    """Print the values of a memory in FILE, in the format of `initial`."""
    kind = ".csv" if output is None else memory_file.kind_of(output)
    found = _contents(file, set_aside=set_aside)
    areas = {} if set_aside and not found else found[_chosen(found, name, file)]
    text = memory_file.written(areas, kind, zeros=zeros)
    if output is None:
        click.echo(text, nl=False)
    else:
        memory_file.write(output, text)


@memory.command("import", epilog="Example: holdfast memory import setpoints.redb setpoints.csv")
@click.argument("file", type=EXISTING_FILE)
@click.argument("values", type=FILE)
@_of_memory
@flag("--merge", "Keep values that VALUES does not have.")
def import_(file: Path, values: Path, name: str | None, merge: bool) -> None:
    """Store VALUES in a memory of FILE; all its other values become 0.

    VALUES is a .csv or .yaml file in the format of `initial`. It is checked completely first.
    """
    memory_file.kind_of(values)
    found = _contents(file)
    chosen = _chosen(found, name, file)
    areas = found[chosen]
    try:
        spans: dict[str, range | None] = {area: kept.addresses for area, kept in areas.items()}
        content = read(values, str(values), spans)
        runs, problems = parse(content, str(values), spans)
    except ConfigError as error:
        runs, problems = (), list(error.problems)
    if problems:
        fail("\n".join(str(problem) for problem in problems), ExitCode.WRONG)
    try:
        memory_file.replace(file, chosen, runs, merge=merge)
    except OSError as error:
        fail(error, ExitCode.WRONG)
    count = sum(len(run.values) for run in runs)
    click.echo(f"{chosen}: {count:,} values stored in {file}")


@memory.command(epilog="Example: holdfast memory release setpoints.redb")
@click.argument("file", type=EXISTING_FILE)
@_of_memory
def release(file: Path, name: str | None) -> None:
    """Delete the values in FILE that were set aside, for good.

    They are at addresses that the memory had before, and does not have in the configuration of the
    last start. `holdfast memory export --set-aside` prints them.
    """
    found = _contents(file, set_aside=True)
    if not found:
        click.echo(f"{file}: no values are set aside")
        return
    chosen = _chosen(found, name, file)
    try:
        memory_file.release(file, chosen)
    except OSError as error:
        fail(error, ExitCode.WRONG)
    _show(f"released of {chosen}", found[chosen])


def _contents(file: Path, *, set_aside: bool = False) -> dict[str, dict[Area, KeptArea]]:
    try:
        return memory_file.contents(file, set_aside=set_aside)
    except OSError as error:
        fail(error, ExitCode.WRONG, reason="file")


def _places(found: dict[str, dict[Area, KeptArea]]) -> dict[str, dict[Area, dict[str, int]]]:
    return {
        name: {
            area: {"address": kept.start, "count": len(kept.values)} for area, kept in areas.items()
        }
        for name, areas in found.items()
    }


def _show(name: str, areas: dict[Area, KeptArea]) -> None:
    for area, kept in areas.items():
        set_ = sum(map(bool, kept.values))
        click.echo(f"{name}: {area} {extent(kept.addresses)}, {set_:,} not 0")


def _chosen(found: dict[str, dict[Area, KeptArea]], name: str | None, file: Path) -> str:
    if not found:
        raise click.UsageError(f"{file} has no memories")
    return memory_file.chosen(found, name, file)
