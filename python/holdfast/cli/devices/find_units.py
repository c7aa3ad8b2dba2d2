"""`holdfast find URL`: unit ids that answer."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import terminal_text
from holdfast.cli.device_errors import hint_at_silence
from holdfast.cli.devices.search_report import (
    NOTHING,
    Report,
    ended_to_json,
    ignored_text,
    ignored_to_json,
)
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options import device
from holdfast.cli.options.units import refuse_broadcast
from holdfast.cli.signals import interruptions
from holdfast.cli.terminal_text import number_ranges
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import parse
from holdfast.discovery import device_search

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.discovery.device_search import Unit

ROW = "{:>4}  {:7}  {}"
"""A row of the table: unit id, answer, identification."""


def find_units(
    url: str, unit_ids: Sequence[int], timeout: float, delay: float, as_json: bool
) -> None:
    """Finds unit ids and prints them.

    Exits with 1 if there are none, or if the search ended early.
    """
    is_line = isinstance(parse(url), SerialTarget)
    if is_line:
        refuse_broadcast(unit_ids)
    if sys.stderr.isatty():
        most = (len(unit_ids) + 1) * (timeout + delay)  # The first is asked twice.
        told = f"{len(unit_ids)} unit ids, at most {most:.0f} s if none answers. Ctrl-C stops."
        click.echo(told, err=True)
    by_unit: dict[int, Unit] = {}
    found = by_unit.values()
    with interruptions() as signals:
        report = Report({"target": url}, signals)
        alike: list[Unit] = []

        def search() -> None:
            nonlocal alike
            with report.progress("Finding", len(unit_ids), lambda: f"{_count(found)} found"):
                for unit in device_search.units(client, unit_ids, delay=delay):
                    with report.held():
                        by_unit[unit.unit] = unit
                        if unit.answers:
                            _print(unit, report, is_first=_count(found) == 1)
                        report.advance(len(found))
                alike = device_search.like_unusual(client, [*found], is_line=is_line, delay=delay)

        with device.connect(url, unit_ids[0], timeout) as client:
            why = report.attempt(search, url, lambda: _count(found))
        not_asked = unit_ids[len(found) :]
        report.text(*_units(url, [*found], not_asked, alike))
        report.end(
            {
                **ended_to_json(why or (None if _count(found) else NOTHING)),
                "complete": why is None,
                "garbled": _garbled(found),
                **ignored_to_json([*found], alike),
                "asked": [each.unit for each in found],
                "not_asked": list(not_asked),
            }
        )
    if why is not None and not as_json:
        click.echo(f"holdfast: {url}: {why}", err=True)
    hint_at_silence(url, [*found], client.longest_late)
    if why is not None or not _count(found):
        sys.exit(ExitCode.FAILED)


def _print(unit: Unit, report: Report, *, is_first: bool) -> None:
    identity = terminal_text.plain(str(unit.identity))
    row = ROW.format(str(unit.unit), unit.detail, identity).rstrip()
    head = terminal_text.styled(ROW.format("unit", "answer", "identification"), bold=True)
    report.text(*([head] if is_first else []), row)
    report.entry(unit_to_json(unit))


def _count(found: Iterable[Unit]) -> int:
    return sum(each.answers for each in found)


def _garbled(found: Iterable[Unit]) -> list[int]:
    """The unit ids whose replies are invalid."""
    return [each.unit for each in found if each.is_garbled]


def unit_to_json(found: Unit) -> dict[str, object]:
    """A unit id for JSON."""
    return {
        "unit": found.unit,
        "detail": found.detail,
        "identification": dict(found.identity.objects),
    }


def _units(
    url: str, found: Sequence[Unit], not_asked: Sequence[int], alike: Sequence[Unit]
) -> list[str]:
    """The summary at the end of the search."""
    count = _count(found)
    silent = [each.unit for each in found if not each.answers and not each.is_garbled]
    lines = [""] if count else []
    lines.append(f"{url}: {terminal_text.counted(count, 'unit id')} of {len(found)} asked answer")
    if silent:
        lines.append(f"no device: {number_ranges(silent)}")
    if garbled := _garbled(found):
        lines.append(f"invalid replies: {number_ranges(garbled)}")
    if not_asked:
        lines.append(f"not asked: {number_ranges(not_asked)}")
    if alike:
        lines.append(ignored_text(found, alike))
    return lines
