"""`holdfast describe`: describes a device that nobody documented, as a tag list."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli import device
from holdfast.cli.describe_output import described_lines, described_told
from holdfast.cli.progress import bar
from holdfast.cli.surveying import announced, limited, planned, survey_options
from holdfast.cli.unit_ids import unit_ids
from holdfast.client.url import SerialTarget, parse
from holdfast.config.tag_files import KINDS
from holdfast.config.tag_output import tags_as_csv, tags_as_yaml
from holdfast.errors import ConnectFailed, ModbusError
from holdfast.tools import description, finding
from holdfast.tools.description import Description
from holdfast.tools.discovery import LimitReached

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Unpack

    from holdfast.cli.surveying import Settings
    from holdfast.client import SyncClient
    from holdfast.tools.finding import Unit

UNITS = "1-10,255"
LINE_UNITS = "1-10"
SHOWN = 60
"""The most lines of tags in the text; a file and JSON have all tags."""


def _file(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in KINDS:
        raise click.BadParameter(f"{text!r} ends with none of {', '.join(KINDS)}.")
    if not path.absolute().parent.is_dir():
        raise click.BadParameter(f"the folder of {text!r} does not exist.")
    return path


@click.command(epilog="Example: holdfast describe tcp://192.168.0.10 --output meter.yaml")
@device.url_argument
@click.option(
    "--units",
    type=unit_ids,
    metavar="LIST",
    help=f"Unit ids to ask, as in 1-10,255.  [default: {UNITS}; {LINE_UNITS} on a serial line]",
)
@click.option(
    "--output",
    type=_file,
    metavar="FILE",
    help="Write the tag list to FILE: YAML or CSV, by its suffix.",
)
@click.option("--force", is_flag=True, help="Replace FILE if it exists.")
@survey_options
@click.option(
    "--reads",
    type=click.IntRange(1, 100),
    default=3,
    show_default=True,
    metavar="N",
    help="Number of reads of each address, to observe changes.",
)
@click.option(
    "--every",
    type=device.seconds,
    default="1",
    show_default=True,
    metavar="SECONDS",
    help="Pause between these reads.",
)
@click.option("--all", "everything", is_flag=True, help=f"Show all tags, not only {SHOWN} lines.")
@click.option(
    "--timeout",
    type=device.seconds,
    default="1",
    show_default=True,
    metavar="SECONDS",
    help="Time limit for connection, request and reply together.",
)
@device.json_option
def describe(
    url: str,
    units: tuple[int, ...] | None,
    output: Path | None,
    force: bool,
    reads: int,
    every: float,
    everything: bool,
    timeout: float,
    as_json: bool,
    **settings: Unpack[Settings],
) -> None:
    """Describe the device at URL by reading: which unit ids answer, which addresses exist, and what
    they probably mean. Nothing is written to the device.

    Asks each unit id for its identification (functions 43/14 and 17), decodes SunSpec models by
    their published definitions, finds other addresses as `holdfast map` does, reads them several
    times, and infers types and byte order. The result is a list of tags that do not overlap.

    The confidence of a tag is the probability of its type and order. Names, scales and units of
    guessed tags are not known: compare the values with a display or a manual, then edit the file.
    Registers that are always 0 say nothing about their type.

    Ctrl-C prints and writes the results so far.

    Exit codes: 0 done; 1 no unit id answered, or the search ended early; 2 wrong usage.
    """
    is_line = isinstance(parse(url), SerialTarget)
    asked = units or unit_ids(LINE_UNITS if is_line else UNITS)
    if is_line and 0 in asked:
        raise click.UsageError("Unit id 0 is the broadcast on a serial line: nobody answers it.")
    if output is not None and output.exists() and not force:
        raise click.UsageError(f"{output} exists; --force replaces it.")
    found: list[Description] = []
    seen: list[Unit] = []
    why = None
    ignores = False
    with device.connect(url, asked[0], timeout) as client:
        try:
            with bar("Asking", len(asked), lambda: "") as advance:
                for unit in finding.units(client, asked, delay=settings["delay"]):
                    seen.append(unit)
                    if advance:
                        advance(len(seen))
            answering = [each.unit for each in seen if each.answers]
            if 1 < len(asked) == len(answering) and not is_line:
                ignores = finding.ignores_unit(client, asked)
                answering = answering[:1] if ignores else answering
            for number in answering:
                client.unit = number
                found.append(Description(number, planned(settings)))
                _describe(found[-1], client, reads, every, settings["delay"])
        except ConnectFailed as error:
            device.fail(error, url, {"url": url} if as_json else None)
        except LimitReached as error:
            why = limited(error)
        except ModbusError as error:
            why = str(error)
        except KeyboardInterrupt:
            why = "interrupted"
    if found and sys.stderr.isatty():
        click.echo("Inferring types.", err=True)
    for each in found:
        description.conclude(each, now=time.time())
    if not any(unit.answers for unit in seen) and why is None:
        why = "no unit id answered"
    files = _written(found, output)
    if as_json:
        click.echo(
            json.dumps(described_told(url, asked, seen, found, ignores, why, files), indent=2)
        )
    else:
        lines = described_lines(url, asked, seen, found, ignores, None if everything else SHOWN)
        click.echo("\n".join([*lines, *(f"Written: {file}" for file in files)]))
        if why is not None:
            click.echo(f"holdfast: {url}: {why}", err=True)
    if why is not None:
        sys.exit(device.FAILED)


def _describe(
    found: Description, client: SyncClient, reads: int, every: float, delay: float
) -> None:
    survey = found.survey
    if sys.stderr.isatty():
        click.echo(f"Unit {found.unit}: {announced(survey)}", err=True)
    note = f"unit {found.unit}"
    with bar("Mapping", survey.total, lambda: note) as advance:
        description.describe(
            found,
            client,
            reads=reads,
            every=every,
            delay=delay,
            progress=advance and (lambda survey: advance(survey.at)),
        )


def _written(found: Sequence[Description], output: Path | None) -> list[str]:
    """Writes the tag lists. Returns the paths of the files: one, or one for each unit id."""
    if output is None:
        return []
    files = []
    with_tags = [each for each in found if each.tags]
    for each in with_tags:
        tags = [tag.tag for tag in each.tags]
        path = output
        if len(with_tags) > 1:
            path = output.with_stem(f"{output.stem}-unit{each.unit}")
        text = tags_as_csv(tags) if path.suffix.lower() == ".csv" else tags_as_yaml(tags)
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise click.FileError(str(path), str(error.strerror)) from error
        files.append(str(path))
    return files
