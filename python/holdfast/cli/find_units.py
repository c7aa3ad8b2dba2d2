"""`holdfast find URL`: unit ids that answer."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, showing
from holdfast.cli.report import Report
from holdfast.cli.signals import Interrupted, interruptions
from holdfast.cli.unit_ids import listed
from holdfast.client.url import SerialTarget, parse
from holdfast.errors import ConnectFailed
from holdfast.tools import finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.cli.signals import Signals
    from holdfast.client import SyncClient
    from holdfast.tools.finding import Unit

ALL = 247
"""How many unit ids the standard has: with all asked, no other is rare."""


ROW = "{:>4}  {:7}  {}"
"""A row of the table: unit id, answer, identification."""


def find_units(url: str, asked: Sequence[int], timeout: float, delay: float, as_json: bool) -> None:
    """Finds unit ids, prints them, and exits with 1 if there are none."""
    if isinstance(parse(url), SerialTarget) and 0 in asked:
        raise click.UsageError("Unit id 0 is the broadcast on a serial line: nobody answers it.")
    if sys.stderr.isatty():
        most = len(asked) * (timeout + delay)
        click.echo(f"{len(asked)} unit ids, at most {most:.0f} s. Ctrl-C stops.", err=True)
    found: list[Unit] = []
    with interruptions() as signals:
        report = Report({"url": url} if as_json else None, signals, listed="units")
        with device.connect(url, asked[0], timeout) as client:
            why, ignores = _search(client, url, asked, delay, found, report, signals)
        left = asked[len(found) :]
        report.text(*_units(url, found, left, ignores))
        report.end(
            {
                "ok": why is None and _count(found) > 0,
                **({} if why is None else {"detail": why}),
                "complete": why is None,
                "ignores_unit": ignores,
                "asked": [each.unit for each in found],
                "not_asked": list(left),
            }
        )
    if why is not None and not as_json:
        click.echo(f"holdfast: {url}: {why}", err=True)
    if why is not None or not _count(found):
        sys.exit(device.FAILED)


def _search(
    client: SyncClient,
    url: str,
    asked: Sequence[int],
    delay: float,
    found: list[Unit],
    report: Report,
    signals: Signals,
) -> tuple[str | None, bool]:
    """Asks unit ids, and prints those that answer.

    Returns why it ended early, or `None`, and whether the device ignores unit ids.
    """
    try:
        with (
            report.progress("Finding", len(asked), lambda: f"{_count(found)} found"),
            signals.interrupting(),
        ):
            for unit in finding.units(client, asked, delay=delay):
                with report.held():
                    found.append(unit)
                    if unit.answers:
                        _print(unit, report, is_first=_count(found) == 1)
                    report.advance(len(found))
            return None, _ignores(client, url, found)
    except ConnectFailed as error:
        if not _count(found):
            device.fail(error, url, {"url": url} if report.is_json else None)
        return str(error), False
    except Interrupted:
        return "interrupted", False


def _print(unit: Unit, report: Report, *, is_first: bool) -> None:
    identity = showing.plain(str(unit.identity))
    row = ROW.format(str(unit.unit), unit.detail, identity).rstrip()
    head = showing.styled(ROW.format("unit", "answer", "identification"), bold=True)
    report.text(*([head] if is_first else []), row)
    report.entry(unit_told(unit))


def _ignores(client: SyncClient, url: str, found: Sequence[Unit]) -> bool:
    """Whether the device probably ignores the unit id: it answers all, also a rare one."""
    if isinstance(parse(url), SerialTarget) or len(found) < 2 or _count(found) < len(found):
        return False
    asked = [each.unit for each in found]
    return len(asked) >= ALL or finding.ignores_unit(client, asked)


def _count(found: Iterable[Unit]) -> int:
    return sum(each.answers for each in found)


def unit_told(found: Unit) -> dict[str, object]:
    """A unit id for JSON."""
    return {
        "unit": found.unit,
        "detail": found.detail,
        "identification": dict(found.identity.objects),
    }


def _units(url: str, found: Sequence[Unit], left: Sequence[int], ignores: bool) -> list[str]:
    """What is known when the search has ended."""
    count = _count(found)
    silent = [each.unit for each in found if not each.answers]
    lines = [""] if count else []
    lines.append(f"{url}: {showing.counted(count, 'unit id')} of {len(found)} asked answer")
    if silent:
        lines.append(f"no device: {listed(silent)}")
    if left:
        lines.append(f"not asked: {listed(left)}")
    if ignores:
        lines.append("The device answers every unit id: it probably ignores them.")
    return lines
