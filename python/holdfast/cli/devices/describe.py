"""`holdfast describe`: describes an undocumented device as a tag list."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli import CommandWithSubcommands, complete_subcommand, device_errors
from holdfast.cli.devices.describe_output import (
    described_lines,
    head_lines,
    sunspec_to_json,
    unit_to_json,
    units_lines,
    units_to_json,
)
from holdfast.cli.devices.search_report import (
    INTERRUPTED,
    Ended,
    RangeReport,
    Report,
    ended_to_json,
)
from holdfast.cli.exit_codes import fail
from holdfast.cli.options import device
from holdfast.cli.options.duration import every_option, timeout_option
from holdfast.cli.options.option import flag, json_option, number_option, option
from holdfast.cli.options.search import announced, planned, survey_options
from holdfast.cli.options.units import refuse_broadcast, unit_ids
from holdfast.cli.options.url import checked_url
from holdfast.cli.signals import interruptions
from holdfast.cli.terminal_text import number_ranges
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import parse
from holdfast.config.tag_files.read import KINDS, MAX_BYTES
from holdfast.config.tag_files.write import tags_as_csv, tags_as_yaml
from holdfast.discovery import description, device_search
from holdfast.discovery.description import Description
from holdfast.discovery.line_search import LINE_UNITS
from holdfast.runtime import whole_files

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.cli.options.search import Settings
    from holdfast.client import SyncClient
    from holdfast.discovery.device_search import Unit

UNITS = (*LINE_UNITS, 255)
_UNITS_HELP = (
    f"Unit ids to ask, as in 1-10,255.  [default: {number_ranges(UNITS)}; "
    f"{number_ranges(LINE_UNITS)} on a serial line]"
)
MAX_LINES = 60
"""The most lines of tags in the text; a file and JSON have all tags."""

INFERENCE_S = 2
"""The time for what was found when a signal has ended the search."""


def _file(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in KINDS:
        raise click.BadParameter(f"{text!r} ends with none of {', '.join(KINDS)}.")
    if not path.absolute().parent.is_dir():
        raise click.BadParameter(f"the folder of {text!r} does not exist.")
    return path


def _require_writable(file: Path, *, force: bool) -> None:
    """Raises `click.UsageError` for a file that can't be written, before a search of minutes."""
    try:
        if file.exists() and not force:
            raise click.UsageError(f"{file} exists; --force replaces it.")
        if file.is_dir():
            raise click.UsageError(f"{file} is a folder.")
        whole_files.try_replace(file)
    except OSError as error:
        raise click.UsageError(f"{file} can't be written: {error.strerror}.") from error


SUBCOMMANDS = {
    "map": ("devices.map_command:map_", "Find the addresses of a device."),
    "guess": ("devices.guess:guess", "Guess the type and byte order of a value."),
    "identify": ("devices.identify:identify", "Print the identification of a device."),
    "status": ("devices.status:status", "Print exception status, event counter and event log."),
}


@click.command(
    cls=CommandWithSubcommands,
    subcommands=SUBCOMMANDS,
    epilog="Example: holdfast describe tcp://192.168.0.10 --output meter.yaml",
)
@click.argument("url", type=checked_url, metavar="URL", shell_complete=complete_subcommand)
@option("--units", "LIST", _UNITS_HELP, unit_ids)
@option("--output", "FILE", "Write the tag list to FILE: YAML or CSV, by its suffix.", _file)
@flag("--force", "Replace FILE if it exists.")
@survey_options
@number_option("--times", "Number of readings of each address, to observe changes.", 1, 100, 3)
@every_option("1", "Interval between these readings.")
@flag("--all everything", f"Show all tags, not only {MAX_LINES} lines.")
@timeout_option()
@json_option
def describe(
    url: str,
    units: tuple[int, ...] | None,
    output: Path | None,
    force: bool,
    settings: Settings,
    times: int,
    every: float,
    everything: bool,
    timeout: float,
    as_json: bool,
) -> None:
    """Describe the device at URL by reading: which unit ids answer, which addresses exist, and what
    they probably mean. Nothing is written to the device.

    Asks each unit id for its identification (functions 43/14 and 17), decodes SunSpec models by
    their published definitions, finds other addresses as `describe map` does, reads them several
    times, and infers types and byte order. The result is a list of tags that do not overlap.

    The confidence of a tag is the probability of its type and order. Names, scales and units of
    guessed tags are not known: compare the values with a display or a manual, then edit the file.
    Registers that are always 0 say nothing about their type.

    The registers at usual starts come first, then the other registers, then coils and discrete
    inputs. Unit ids and ranges are printed when they are found; with --json, as elements of
    "found". Each unit id is written to FILE when its description is complete.

    Ctrl-C, or SIGTERM, prints and writes the results so far, where the search did not look, and
    what has no tags yet. A second one ends the command at once. FILE is replaced as a whole, or
    not at all. If it can't be written at the end, the tag list is printed.

    Exit codes: 0 done; 1 no unit id answered, the search ended early, or not all that was found
    could be read again; 2 wrong usage.
    """
    is_line = isinstance(parse(url), SerialTarget)
    asked = units or (LINE_UNITS if is_line else UNITS)
    if is_line:
        refuse_broadcast(asked)
    if output is not None:
        _require_writable(output, force=force)
    with interruptions() as signals:
        report = Report({"target": url}, signals)
        most = None if everything else MAX_LINES
        run = _Run(url, asked, settings, times, every, output, force, most, report)
        with device.connect(url, asked[0], timeout) as client:
            why = run.carry_out(client, is_line=is_line)
        run.end(why)
    try:
        if why is not None:
            fail(f"{url}: {why}", is_printed=as_json)
    finally:
        device_errors.hint_at_silence(url, run.seen, client.longest_late)


@dataclass
class _Run:
    """The search of a device, and its findings so far."""

    url: str
    asked: Sequence[int]
    settings: Settings
    times: int
    every: float
    output: Path | None
    replaces: bool
    """Whether a file may be replaced."""
    most: int | None
    """The most lines of tags in the text."""
    report: Report

    def __post_init__(self) -> None:
        self._by_unit: dict[int, Unit] = {}
        self._alike: list[Unit] = []
        self._found: list[Description] = []
        self._files: list[str] = []
        self._unwritten: Ended | None = None
        """The error of the first file that could not be written."""

    @property
    def seen(self) -> list[Unit]:
        """The unit ids that were asked."""
        return list(self._by_unit.values())

    @property
    def _answering(self) -> list[Unit]:
        return [each for each in self.seen if each.answers]

    @property
    def _to_describe(self) -> list[Unit]:
        return device_search.devices(self.seen, self._alike)

    @property
    def _unread(self) -> Ended | None:
        units = [each.unit for each in self._found if each.unread]
        if not units:
            return None
        detail = f"of unit ids {number_ranges(units)}, not all that was found could be read again"
        return Ended("exception", detail)

    def carry_out(self, client: SyncClient, *, is_line: bool) -> Ended | None:
        """Asks unit ids, and describes those that answer. Returns why it ended early, or `None`."""
        why = self._attempt(lambda: self._ask(client, is_line=is_line))
        self.report.text(*units_lines(self.url, self.asked, self.seen, self._alike))
        if why is not None:
            return why
        for each in self._to_describe:
            client.unit = each.unit
            found = Description(each.unit, planned(self.settings), each.identity)
            unit = _UnitReport(found, self.report)
            self._found.append(unit.found)
            why = self._conclude(unit, self._attempt(partial(self._describe, unit, client)))
            if why is not None:
                break
        unwritten = self._unwritten or self._unread
        if why is not None and unwritten is not None:
            return replace(why, detail=f"{why}; {unwritten}")
        if why is not None:
            return why
        return unwritten if self._found else Ended("nothing", "no unit id answered")

    def end(self, why: Ended | None) -> None:
        """Prints what is known when the search has ended."""
        left = [each.unit for each in self._to_describe[len(self._found) :]]
        if left:
            self.report.text("", f"Incomplete. Not described: unit ids {number_ranges(left)}.")
        self.report.end(
            {
                **ended_to_json(why),
                **units_to_json(self.asked, self.seen, self._alike),
                "not_described": left,
                "files": self._files,
                "units": [unit_to_json(each) for each in self._found],
            }
        )

    def _attempt(self, work: Callable[[], None]) -> Ended | None:
        return self.report.attempt(work, self.url, lambda: self._answering)

    def _ask(self, client: SyncClient, *, is_line: bool) -> None:
        asked, delay = self.asked, self.settings.delay
        with self.report.progress("Asking", len(asked), lambda: ""):
            for unit in device_search.units(client, asked, delay=delay):
                with self.report.held():
                    self._by_unit[unit.unit] = unit
                    self.report.advance(len(self.seen))
                    if unit.answers:
                        self.report.text(f"Unit {unit.unit} answers.")
                        about = dict(unit.identity.objects)
                        self.report.entry({"unit": unit.unit, "identification": about})
        if len(asked) == len(self.seen):
            self._alike = device_search.like_unusual(
                client, self.seen, is_line=is_line, delay=delay
            )

    def _describe(self, unit: _UnitReport, client: SyncClient) -> None:
        survey = unit.found.survey
        if sys.stderr.isatty():
            click.echo(f"Unit {unit.found.unit}: {announced(survey)}", err=True)
        with self.report.progress("Mapping", survey.total, lambda: f"unit {unit.found.unit}"):
            description.describe(
                unit.found,
                client,
                reads=self.times,
                every=self.every,
                delay=self.settings.delay,
                progress=lambda _: unit.update(),
            )

    def _conclude(self, unit: _UnitReport, why: Ended | None) -> Ended | None:
        """Infers the tags of a unit id, writes its file, and prints them.

        `why` is why its search ended early. Returns that, or why the inference did.
        """
        unit.end()
        if sys.stderr.isatty():
            click.echo("Inferring types.", err=True)
        infer = partial(description.conclude, unit.found, now=time.time())
        if why is INTERRUPTED:
            infer(seconds=INFERENCE_S)
        else:
            why = self._attempt(infer) or why
        written = self._write(unit.found)
        self.report.text(*described_lines(unit.found, self.most))
        self.report.text(*written)
        return why

    def _write(self, found: Description) -> list[str]:
        """Writes the tag list of a unit id: to a file of its own if several answer.

        Returns what to print of it: the file, or the tag list if it can't be written.
        """
        path = self.output
        if path is None or not found.tags:
            return []
        tags = [each.tag for each in found.tags]
        text = tags_as_csv(tags) if path.suffix.lower() == ".csv" else tags_as_yaml(tags)
        if len(self._to_describe) > 1:
            path = path.with_stem(f"{path.stem}-unit{found.unit}")
            if path.exists() and not self.replaces:
                self._fail_to_write(f"{path} exists; --force replaces it")
                return ["", text]
        data = text.encode()
        if len(data) > MAX_BYTES:
            self._fail_to_write(
                f"{path} has {len(data)} bytes, and other commands read tag lists of up to "
                f"{MAX_BYTES}: divide it, or describe it in parts, with --range or --areas"
            )
        try:
            whole_files.replace(path, data)
        except OSError as error:
            self._fail_to_write(f"{path} can't be written: {error.strerror}")
            return ["", text]
        self._files.append(str(path))
        return [f"Written: {path}"]

    def _fail_to_write(self, why: str) -> None:
        self._unwritten = self._unwritten or Ended("file", why)


class _UnitReport:
    """The output about a unit id while it is described."""

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
                fields = {"unit": self.found.unit, "sunspec": sunspec_to_json(self.found.sunspec)}
                self._report.entry(fields)
