"""The output of searches: findings as they come, and a summary at the end."""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import click

from holdfast.cli import answers, device_errors, terminal_text
from holdfast.cli.progress import bar
from holdfast.cli.signals import Interrupted
from holdfast.cli.terminal_text import number_ranges
from holdfast.discovery.address_search import LimitReached
from holdfast.discovery.device_search import UNUSUAL_UNIT
from holdfast.errors import ConnectFailed, ModbusError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from holdfast.cli.progress import Bar
    from holdfast.cli.signals import Signals
    from holdfast.discovery.address_search import Finding, Survey
    from holdfast.discovery.device_search import Unit


@dataclass(frozen=True)
class Ended:
    """Why a search has not found all that was asked."""

    reason: str
    detail: str
    code: int | None = None

    def __str__(self) -> str:
        return self.detail


def ended_to_json(why: Ended | None) -> dict[str, object]:
    """Whether all that was asked is there, and if not, why."""
    if why is None:
        return {"ok": True}
    return {"ok": False, **{key: value for key, value in asdict(why).items() if value is not None}}


RANGE = "{:17}  {:>5}  {:>5}  {:>5}"
"""A row of the table of ranges: area, first, last, count."""


INTERRUPTED = Ended("interrupted", "interrupted")
NOTHING = Ended("nothing", "no device answered")


class Report:
    """The output of a search: lines of text; with `--json`, one JSON object.

    The object begins with `about` and a list, whose elements are the findings: each is written at
    once, on a line of its own. An interruption does not cut a line.
    """

    def __init__(self, about: Mapping[str, object], signals: Signals | None = None) -> None:
        self._is_json = answers.wanted()
        self._about = about
        self._bar: Bar | None = None
        self._signals = signals
        self._has_begun = False

    @contextlib.contextmanager
    def progress(self, label: str, length: int, note: Callable[[], str]) -> Iterator[None]:
        """Shows a progress bar below what is printed, on a terminal."""
        with bar(label, length, note) as self._bar:
            try:
                yield
            finally:
                self._bar = None

    def advance(self, at: int) -> None:
        """Sets the progress, from 0 to its length."""
        if self._bar is not None:
            self._bar(at)

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Lets what is inside end before a signal ends the search."""
        return contextlib.nullcontext() if self._signals is None else self._signals.held()

    def attempt(
        self, work: Callable[[], None], target: str, found: Callable[[], object]
    ) -> Ended | None:
        """Does something that a signal can end. Returns why it ended early, or `None`.

        Exits if the device can't be reached and nothing was found before.
        """
        assert self._signals is not None
        try:
            with self._signals.interrupting():
                work()
        except LimitReached as error:
            return Ended("limit", f"{error}; --max-requests sets the limit")
        except ModbusError as error:
            if isinstance(error, ConnectFailed) and not found():
                device_errors.fail(error, target)
            return Ended(**device_errors.problem(error))  # type: ignore[arg-type]
        except Interrupted:
            return INTERRUPTED
        return None

    def text(self, *lines: str) -> None:
        """Prints lines, unless the output is JSON."""
        if not self._is_json and lines:
            with self.held():
                self._print("\n".join(lines))

    def entry(self, entry: Mapping[str, object]) -> None:
        """Prints an element of the list, if the output is JSON."""
        if self._is_json:
            with self.held():
                # The comma is at the beginning: each line is complete when it is written.
                comma = "," if self._has_begun else " "
                self._begin()
                self._print(f"   {comma}{json.dumps(entry)}")

    def end(self, rest: Mapping[str, object]) -> None:
        """Prints the rest of the object, if the output is JSON."""
        if self._is_json:
            self._begin()
            self._print("  ],\n" + json.dumps(rest, indent=2).removeprefix("{\n"))

    def _begin(self) -> None:
        if not self._has_begun:
            self._has_begun = True
            fields = [(key, json.dumps(value)) for key, value in self._about.items()]
            about = "".join(f'  "{key}": {value},\n' for key, value in fields)
            self._print(f'{{\n{about}  "found": [')

    def _print(self, text: str) -> None:
        if self._bar is not None:
            self._bar.clear()
        click.echo(text)


class RangeReport:
    """The table of the ranges that a survey finds, as they come.

    `about` is part of the entries for JSON; with it, an empty line is before the table.
    """

    def __init__(
        self, report: Report, survey: Survey, about: Mapping[str, object] | None = None
    ) -> None:
        self._report = report
        self._survey = survey
        self._about = about or {}
        self._printed: list[Finding] = []

    def update(self) -> None:
        """Prints the ranges that were found since the last call."""
        while len(self._printed) < len(self._survey.findings):
            self._row(self._survey.findings[len(self._printed)])

    def end(self) -> None:
        """Prints the other ranges: those whose ends were not read."""
        self.update()
        for finding in self._survey.unfinished():
            self._row(finding)

    def _row(self, finding: Finding) -> None:
        found = finding.addresses
        rows = [RANGE.format(finding.area, found.start, found.stop - 1, len(found))]
        if not self._printed:
            head = RANGE.format("area", "first", "last", "count")
            rows[:0] = [*([""] if self._about else []), terminal_text.styled(head, bold=True)]
        place = {"area": finding.area, "address": found.start, "count": len(found)}
        with self._report.held():
            self._printed.append(finding)
            self._report.text(*rows)
            self._report.entry({**self._about, **place})


def ignored_text(seen: Sequence[Unit], alike: Sequence[Unit]) -> str:
    """What the unit ids are that answer as a rare one does."""
    if len(alike) == len(seen):
        return "The device answers every unit id: it probably ignores them."
    units = number_ranges(each.unit for each in alike)
    return f"Unit ids {units} answer as {UNUSUAL_UNIT} does: probably no devices of their own."


def ignored_to_json(seen: Sequence[Unit], alike: Sequence[Unit]) -> dict[str, object]:
    """The same for JSON."""
    ignores = bool(seen) and len(alike) == len(seen)
    return {"ignores_unit": ignores, "alike": [each.unit for each in alike]}
