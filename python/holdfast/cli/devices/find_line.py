"""`holdfast find SERIAL`: baud, parity and unit ids of a serial line."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import terminal_text
from holdfast.cli.device_errors import hint_at_late_replies
from holdfast.cli.devices.find_units import unit_to_json
from holdfast.cli.devices.search_report import NOTHING, Report, ended_to_json
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options.units import refuse_broadcast
from holdfast.cli.signals import interruptions
from holdfast.cli.terminal_text import number_ranges
from holdfast.discovery import line_search
from holdfast.discovery.line_search import LineSettings

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.cli.devices.search_report import Ended
    from holdfast.client.serial_settings import Parity
    from holdfast.discovery.line_search import Attempt


def find_line(
    mode: str,
    path: str,
    asked: tuple[int, ...] | None,
    bauds: Sequence[int],
    parities: Sequence[Parity],
    timeout: float,
    as_json: bool,
) -> None:
    """Finds the settings of a line, prints them, and exits with 1 if there are none."""
    units = asked or line_search.LINE_UNITS
    refuse_broadcast(units)
    settings = [LineSettings(baud, parity) for baud in bauds for parity in parities]
    total = len(settings) * len(units)
    if sys.stderr.isatty():
        click.echo(
            f"{len(settings)} settings, {len(units)} unit ids: at most {total * timeout:.0f} s. "
            "Ctrl-C stops.",
            err=True,
        )
    attempts: list[Attempt] = []
    with interruptions() as signals:
        report = Report({"target": path}, signals)

        def search() -> None:
            with report.progress("Finding", total, lambda: _tried(attempts)):
                for attempt in line_search.attempts(mode, path, settings, units, timeout):
                    with report.held():
                        attempts.append(attempt)
                        _print(mode, path, attempts, report)
                        report.advance(len(attempts))

        why = report.attempt(search, path, lambda: _found(attempts))
        found = _found(attempts)
        report.text(*_line(path, attempts, found, units))
        report.end(_line_to_json(attempts, found, total, why))
    if why is not None and not as_json:
        click.echo(f"holdfast: {path}: {why}", err=True)
    hint_at_late_replies(max((each.longest_late for each in attempts), default=0.0), timeout)
    if why is not None or not found:
        sys.exit(ExitCode.FAILED)


def _found(attempts: Sequence[Attempt]) -> list[Attempt]:
    return [each for each in attempts if each.found.answers]


def _print(mode: str, path: str, attempts: Sequence[Attempt], report: Report) -> None:
    """Prints the last attempt, if it has found a unit id."""
    found, [attempt] = _found(attempts), attempts[-1:]
    if not attempt.found.answers:
        return
    url = attempt.settings.url(mode, path)
    unit, identity = str(attempt.found.unit), terminal_text.plain(str(attempt.found.identity))
    # The search ends with the first settings that work: all rows have the same URL.
    row = f"{{:>4}}  {{:{len(url)}}}  {{:7}}  {{}}"
    if len(found) == 1:
        head = row.format("unit", "url", "answer", "identification")
        report.text(terminal_text.styled(head, bold=True))
    report.text(row.format(unit, url, attempt.found.detail, identity).rstrip())
    report.entry({"url": url, **unit_to_json(attempt.found)})


def _tried(attempts: Sequence[Attempt]) -> str:
    return f"{attempts[-1].settings.baud} baud" if attempts else ""


def _garbled(attempts: Iterable[Attempt]) -> list[str]:
    """The settings with which bytes came that are not a valid reply."""
    garbled = [each.settings for each in attempts if each.found.is_garbled]
    return list(dict.fromkeys(f"{each.baud} {each.parity}" for each in garbled))


def _unusable(attempts: Iterable[Attempt]) -> list[str]:
    """The settings that the port does not support, with the error."""
    return [
        f"{each.settings.baud} {each.settings.parity}: {each.found.detail}"
        for each in attempts
        if not each.is_usable
    ]


def _line_to_json(
    attempts: Sequence[Attempt], found: Sequence[Attempt], total: int, why: Ended | None
) -> dict[str, object]:
    return {
        **ended_to_json(why or (None if found else NOTHING)),
        "complete": why is None,
        "attempts": len(attempts),
        "attempts_at_most": total,
        "garbled": _garbled(attempts),
        "unusable": _unusable(attempts),
    }


def _line(
    path: str, attempts: Sequence[Attempt], found: Sequence[Attempt], units: Sequence[int]
) -> list[str]:
    """The summary at the end of the search."""
    lines = [""] if found else []
    settings = {each.settings for each in attempts}
    lines.append(
        f"{path}: {terminal_text.counted(len(found), 'unit id')} found; "
        f"unit ids asked: {number_ranges(units)}, "
        f"{terminal_text.counted(len(settings), 'setting')} tried"
    )
    if not found and _garbled(attempts):
        lines.append(
            f"Invalid bytes came at {', '.join(_garbled(attempts))}: a device with other settings, "
            "or noise on the line."
        )
    lines += [f"The port does not support {each}" for each in _unusable(attempts)[:3]]
    return lines
