"""`holdfast import`: converts the configuration of another program."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli.configuration import WRONG, show_problems
from holdfast.cli.places import areas_of
from holdfast.cli.suggesting import SuggestingGroup
from holdfast.config import ConfigError
from holdfast.importing import ORDINALS, NotImportable, read_mma, read_replicator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from holdfast.config import Problem
    from holdfast.importing import Imported, Note
    from holdfast.types import Area

FAILED = 1


def _areas(_context: click.Context, _parameter: click.Parameter, text: str) -> tuple[Area, ...]:
    return areas_of(text) if text else ()


def _common(command: Callable[..., None]) -> Callable[..., None]:
    """Adds the argument and the options of all imports."""
    out = click.Path(path_type=Path)
    for each in (
        click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs."),
        click.option("--force", is_flag=True, help="Overwrite OUT if it exists."),
        click.option("--output", metavar="OUT", type=out, help="Write the YAML to this file."),
        click.argument("file", type=click.Path(path_type=Path)),
    ):
        command = each(command)
    return command


@click.group(
    "import",
    cls=SuggestingGroup,
    epilog="Example: holdfast import mma config.yaml --output plant.yaml",
)
def import_() -> None:
    """Convert the configuration of another program."""


@import_.command(epilog="Example: holdfast import mma config.yaml --output plant.yaml")
@_common
@click.option(
    "--as-it-was-meant/--as-it-ran",
    "as_meant",
    help="Convert keys that the source ignored as documented, or as they ran. Default: as it ran.",
)
@click.option(
    "--keep-published-tokens",
    is_flag=True,
    help="Keep REST tokens that are in the documentation of the source.",
)
@click.option(
    "--grant-rest",
    metavar="AREA[,AREA]",
    default="",
    callback=_areas,
    help="Areas that REST may write too, such as holding_registers.",
)
@click.option(
    "--grant-mqtt",
    metavar="AREA[,AREA]",
    default="",
    callback=_areas,
    help="The same for MQTT.",
)
def mma(
    file: Path,
    output: Path | None,
    force: bool,
    as_json: bool,
    as_meant: bool,
    keep_published_tokens: bool,
    grant_rest: tuple[Area, ...],
    grant_mqtt: tuple[Area, ...],
) -> None:
    """Convert FILE, a configuration of the Modbus Memory Appliance, to a Holdfast configuration.

    Prints the new configuration. Notes on standard error, and comments in the configuration, say
    what was not converted, what was changed and what to check. Exit codes: 0 done, 1 can't write
    OUT, 2 can't import FILE.
    """

    def read() -> Imported:
        return read_mma(
            file,
            as_meant=as_meant,
            keep_published_tokens=keep_published_tokens,
            grant_rest=grant_rest,
            grant_mqtt=grant_mqtt,
        )

    _convert(read, file, output, force, as_json)


@import_.command(epilog="Example: holdfast import replicator replicator.yaml --output mirror.yaml")
@_common
def replicator(file: Path, output: Path | None, force: bool, as_json: bool) -> None:
    """Convert FILE, a configuration of the Modbus Replicator, to a Holdfast configuration.

    Prints the new configuration. Notes on standard error, and comments in the configuration, say
    what was not converted, what was changed and what to check. Exit codes: 0 done, 1 can't write
    OUT, 2 can't import FILE.
    """
    _convert(lambda: read_replicator(file), file, output, force, as_json)


def _convert(
    read: Callable[[], Imported], file: Path, output: Path | None, force: bool, as_json: bool
) -> None:
    if output is not None and _same(file, output):
        raise click.UsageError("OUT and FILE are the same file.")
    try:
        imported = read()
    except ConfigError as error:
        _refuse(error, as_json)
    if output is not None:
        _write(output, imported.to_yaml(), force)
    if as_json:
        click.echo(json.dumps(_answer(imported), indent=2))
        return
    if output is None:
        click.echo(imported.to_yaml(), nl=False)
    for note in imported.notes:
        click.echo(str(note), err=True)
    click.echo(_summary(imported, output), err=True)


def _refuse(error: ConfigError, as_json: bool) -> None:
    """Prints why the import is impossible, and exits with 2."""
    notes = error.notes if isinstance(error, NotImportable) else ()
    if as_json:
        problems = {"ok": False, "problems": _plain(error.problems), "notes": _plain(notes)}
        click.echo(json.dumps(problems, indent=2))
    else:
        for note in notes:
            click.echo(str(note), err=True)
        show_problems(error)
    sys.exit(WRONG)


def _write(output: Path, text: str, force: bool) -> None:
    try:
        with output.open("w" if force else "x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        click.echo(f"{output}: already exists; --force overwrites it", err=True)
        sys.exit(FAILED)
    except OSError as error:
        click.echo(f"{output}: can't be written: {error.strerror or error}", err=True)
        sys.exit(FAILED)


def _same(file: Path, output: Path) -> bool:
    try:
        return file.samefile(output)
    except OSError:
        return False


def _summary(imported: Imported, output: Path | None) -> str:
    of = ""
    if imported.generation is not None:
        of = f" is of the {ORDINALS[imported.generation]} generation"
    count = len(imported.notes)
    notes = "1 note" if count == 1 else f"{count} notes"
    check = f"; next: holdfast check {output}" if output is not None else ""
    return f"{imported.file}{of}: {notes}{check}"


def _answer(imported: Imported) -> dict[str, object]:
    answer: dict[str, object] = {"ok": True, "problems": []}
    if imported.generation is not None:
        answer["generation"] = imported.generation
    return {**answer, "notes": _plain(imported.notes), "config": imported.data}


def _plain(entries: Iterable[Note | Problem]) -> list[dict[str, object]]:
    return [dataclasses.asdict(entry) for entry in entries]
