"""`holdfast find SERIAL`: baud, parity and unit ids of a serial line."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, showing
from holdfast.cli.find_units import unit_told
from holdfast.cli.report import Report
from holdfast.cli.signals import Interrupted, interruptions
from holdfast.cli.unit_ids import listed
from holdfast.errors import ConnectFailed
from holdfast.tools import finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.client.url import Parity
    from holdfast.tools.finding import Attempt

LINE_UNITS = tuple(range(1, 11))


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
    units = asked or LINE_UNITS
    if 0 in units:
        raise click.UsageError("Unit id 0 is the broadcast on a serial line: nobody answers it.")
    settings = finding.line_settings(bauds, parities)
    total = len(settings) * len(units)
    if sys.stderr.isatty():
        click.echo(
            f"{len(settings)} settings, {len(units)} unit ids: at most {total * timeout:.0f} s. "
            "Ctrl-C stops.",
            err=True,
        )
    attempts: list[Attempt] = []
    with interruptions() as signals:
        report = Report({"device": path} if as_json else None, signals, listed="units")
        why = None
        try:
            with (
                report.progress("Finding", total, lambda: _tried(attempts)),
                signals.interrupting(),
            ):
                for attempt in finding.line(mode, path, settings, units, timeout):
                    with report.held():
                        attempts.append(attempt)
                        _print(mode, path, attempts, report)
                        report.advance(len(attempts))
        except ConnectFailed as error:
            if not _found(attempts):
                device.fail(error, path, {"device": path} if as_json else None)
            why = str(error)
        except Interrupted:
            why = "interrupted"
        found = _found(attempts)
        report.text(*_line(path, attempts, found, units))
        report.end(_line_told(attempts, found, total, why))
    if why is not None and not as_json:
        click.echo(f"holdfast: {path}: {why}", err=True)
    device.tell_late(max((each.longest_late for each in attempts), default=0.0), timeout)
    if why is not None or not found:
        sys.exit(device.FAILED)


def _found(attempts: Sequence[Attempt]) -> list[Attempt]:
    return [each for each in attempts if each.found is not None and each.found.answers]


def _print(mode: str, path: str, attempts: Sequence[Attempt], report: Report) -> None:
    """Prints the last attempt, if it has found a unit id."""
    found, [attempt] = _found(attempts), attempts[-1:]
    if attempt.found is None or not attempt.found.answers:
        return
    url = attempt.settings.url(mode, path)
    unit, identity = str(attempt.unit), showing.plain(str(attempt.found.identity))
    # The search ends with the first settings that work: all rows have the same URL.
    row = f"{{:>4}}  {{:{len(url)}}}  {{:7}}  {{}}"
    if len(found) == 1:
        head = row.format("unit", "url", "answer", "identification")
        report.text(showing.styled(head, bold=True))
    report.text(row.format(unit, url, attempt.detail, identity).rstrip())
    report.entry({"url": url, **unit_told(attempt.found)})


def _tried(attempts: Sequence[Attempt]) -> str:
    return f"{attempts[-1].settings.baud} baud" if attempts else ""


def _garbled(attempts: Iterable[Attempt]) -> list[str]:
    """The settings with which bytes came that are not a valid reply."""
    found = {
        f"{each.settings.baud} {each.settings.parity}": None for each in attempts if each.is_garbled
    }
    return list(found)


def _unusable(attempts: Iterable[Attempt]) -> list[str]:
    """The settings that the port does not support, with the error."""
    return [
        f"{each.settings.baud} {each.settings.parity}: {each.detail}"
        for each in attempts
        if each.found is None
    ]


def _line_told(
    attempts: Sequence[Attempt], found: Sequence[Attempt], total: int, why: str | None
) -> dict[str, object]:
    return {
        "ok": why is None and bool(found),
        **({} if why is None else {"detail": why}),
        "complete": why is None,
        "attempts": len(attempts),
        "attempts_at_most": total,
        "garbled": _garbled(attempts),
        "unusable": _unusable(attempts),
    }


def _line(
    path: str, attempts: Sequence[Attempt], found: Sequence[Attempt], units: Sequence[int]
) -> list[str]:
    """What is known when the search has ended."""
    lines = [""] if found else []
    settings = {each.settings for each in attempts}
    lines.append(
        f"{path}: {showing.counted(len(found), 'unit id')} found; unit ids asked: {listed(units)}, "
        f"{showing.counted(len(settings), 'setting')} tried"
    )
    if not found and _garbled(attempts):
        lines.append(
            f"Invalid bytes came at {', '.join(_garbled(attempts))}: a device with other settings, "
            "or noise on the line."
        )
    lines += [f"The port does not support {each}" for each in _unusable(attempts)[:3]]
    return lines
