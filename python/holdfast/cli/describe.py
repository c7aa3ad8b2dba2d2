"""`holdfast describe`: describes a device that nobody documented, as a tag list."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.certificates import files
from holdfast.cli import device
from holdfast.cli.describe_output import (
    described_lines,
    head_lines,
    sunspec_told,
    unit_told,
    units_lines,
    units_told,
)
from holdfast.cli.report import RangeReport, Report
from holdfast.cli.signals import Interrupted, interruptions
from holdfast.cli.surveying import announced, limited, planned, survey_options
from holdfast.cli.unit_ids import listed, unit_ids
from holdfast.client.url import SerialTarget, parse
from holdfast.config.tag_files import KINDS
from holdfast.config.tag_output import tags_as_csv, tags_as_yaml
from holdfast.errors import ConnectFailed, ModbusError
from holdfast.tools import description, finding
from holdfast.tools.description import Description
from holdfast.tools.discovery import LimitReached

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Unpack

    from holdfast.cli.signals import Signals
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

    The registers at usual starts come first, then the other registers, then coils and discrete
    inputs. Unit ids and ranges are printed when they are found; with --json, as elements of
    "found". Each unit id is written to FILE when its description is complete.

    Ctrl-C, or SIGTERM, prints and writes the results so far, and where the search did not look. A
    second one ends the command at once. FILE is replaced as a whole, or not at all.

    Exit codes: 0 done; 1 no unit id answered, or the search ended early; 2 wrong usage.
    """
    is_line = isinstance(parse(url), SerialTarget)
    asked = units or unit_ids(LINE_UNITS if is_line else UNITS)
    if is_line and 0 in asked:
        raise click.UsageError("Unit id 0 is the broadcast on a serial line: nobody answers it.")
    if output is not None and output.exists() and not force:
        raise click.UsageError(f"{output} exists; --force replaces it.")
    with interruptions() as signals:
        report = Report({"url": url} if as_json else None, signals)
        plan = _Plan(settings, reads, every, output, None if everything else SHOWN)
        run = _Run(url, asked, plan, report, signals)
        with device.connect(url, asked[0], timeout) as client:
            why = run.carry_out(client, ignores_possible=not is_line)
        run.end(why)
    if why is not None:
        if not as_json:
            click.echo(f"holdfast: {url}: {why}", err=True)
        sys.exit(device.FAILED)


@dataclass(frozen=True)
class _Plan:
    """What to do with each unit id."""

    settings: Settings
    reads: int
    every: float
    output: Path | None
    most: int | None
    """The most lines of tags in the text."""


class _Run:
    """The search of a device, and what it has found so far."""

    def __init__(
        self, url: str, asked: Sequence[int], plan: _Plan, report: Report, signals: Signals
    ) -> None:
        self._url = url
        self._asked = asked
        self._plan = plan
        self._report = report
        self._signals = signals
        self._seen: list[Unit] = []
        self._ignores = False
        self._found: list[Description] = []
        self._files: list[str] = []
        self._unwritten: str | None = None
        """Why the first file that could not be written was not."""

    @property
    def _answering(self) -> list[int]:
        return [each.unit for each in self._seen if each.answers]

    @property
    def _to_describe(self) -> list[int]:
        return self._answering[:1] if self._ignores else self._answering

    def carry_out(self, client: SyncClient, *, ignores_possible: bool) -> str | None:
        """Asks unit ids, and describes those that answer. Returns why it ended early, or `None`."""
        why = self._attempt(lambda: self._ask(client, ignores_possible=ignores_possible))
        lines = units_lines(self._url, self._asked, self._seen, self._ignores)
        self._report.text(*lines)
        if why is not None:
            return why
        for number in self._to_describe:
            client.unit = number
            unit = _UnitReport(Description(number, planned(self._plan.settings)), self._report)
            self._found.append(unit.found)
            why = self._attempt(partial(self._describe, unit, client))
            self._conclude(unit)
            if why is not None:
                return why
        return self._unwritten if self._found else "no unit id answered"

    def end(self, why: str | None) -> None:
        """Prints what is known when the search has ended."""
        left = self._to_describe[len(self._found) :]
        if left:
            self._report.text("", f"Incomplete. Not described: unit ids {listed(left)}.")
        self._report.end(
            {
                "ok": why is None,
                **({} if why is None else {"detail": why}),
                **units_told(self._asked, self._seen, self._ignores),
                "not_described": left,
                "files": self._files,
                "units": [unit_told(each) for each in self._found],
            }
        )

    def _attempt(self, work: Callable[[], None]) -> str | None:
        """Does something that a signal can end. Returns why it ended early, or `None`."""
        try:
            with self._signals.interrupting():
                work()
        except LimitReached as error:
            return limited(error)
        except ModbusError as error:
            if isinstance(error, ConnectFailed) and not self._answering:
                device.fail(error, self._url, {"url": self._url} if self._report.is_json else None)
            return str(error)
        except Interrupted:
            return "interrupted"
        return None

    def _ask(self, client: SyncClient, *, ignores_possible: bool) -> None:
        asked = self._asked
        with self._report.progress("Asking", len(asked), lambda: ""):
            for unit in finding.units(client, asked, delay=self._plan.settings["delay"]):
                with self._report.held():
                    self._seen.append(unit)
                    self._report.advance(len(self._seen))
                    if unit.answers:
                        self._report.text(f"Unit {unit.unit} answers.")
                        about = dict(unit.identity.objects)
                        self._report.entry({"unit": unit.unit, "identification": about})
        if ignores_possible and 1 < len(asked) == len(self._answering):
            self._ignores = finding.ignores_unit(client, asked)

    def _describe(self, unit: _UnitReport, client: SyncClient) -> None:
        survey = unit.found.survey
        if sys.stderr.isatty():
            click.echo(f"Unit {unit.found.unit}: {announced(survey)}", err=True)
        with self._report.progress("Mapping", survey.total, lambda: f"unit {unit.found.unit}"):
            description.describe(
                unit.found,
                client,
                reads=self._plan.reads,
                every=self._plan.every,
                delay=self._plan.settings["delay"],
                progress=lambda _: unit.update(),
            )

    def _conclude(self, unit: _UnitReport) -> None:
        """Infers the tags of a unit id, writes its file, and prints them."""
        unit.end()
        if sys.stderr.isatty():
            click.echo("Inferring types.", err=True)
        description.conclude(unit.found, now=time.time())
        file = self._written(unit.found)
        self._report.text(*described_lines(unit.found, self._plan.most))
        if file is not None:
            self._files.append(str(file))
            self._report.text(f"Written: {file}")

    def _written(self, found: Description) -> Path | None:
        """Writes the tag list of a unit id: to a file of its own if several answer."""
        path = self._plan.output
        if path is None or not found.tags:
            return None
        if len(self._to_describe) > 1:
            path = path.with_stem(f"{path.stem}-unit{found.unit}")
        tags = [each.tag for each in found.tags]
        text = tags_as_csv(tags) if path.suffix.lower() == ".csv" else tags_as_yaml(tags)
        try:
            files.replace(path, text.encode())
        except OSError as error:
            self._unwritten = self._unwritten or f"{path} can't be written: {error.strerror}"
            return None
        return path


class _UnitReport:
    """What is printed of a unit id while it is described."""

    def __init__(self, found: Description, report: Report) -> None:
        self.found = found
        self._report = report
        self._ranges = RangeReport(report, found.survey, {"unit": found.unit})
        self._has_head = False

    def update(self) -> None:
        """Prints what was found since the last call."""
        self._head()
        self._ranges.update()
        self._report.advance(self.found.survey.at)

    def end(self) -> None:
        """Prints the other findings."""
        self._head()
        self._ranges.end()

    def _head(self) -> None:
        if self._has_head:
            return
        with self._report.held():
            self._has_head = True
            self._report.text("", *head_lines(self.found))
            if self.found.sunspec is not None:
                told = {"unit": self.found.unit, "sunspec": sunspec_told(self.found.sunspec)}
                self._report.entry(told)
