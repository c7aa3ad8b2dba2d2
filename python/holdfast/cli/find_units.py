"""`holdfast find URL`: unit ids that answer."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, showing
from holdfast.cli.progress import bar
from holdfast.cli.unit_ids import listed
from holdfast.client.url import SerialTarget, parse
from holdfast.errors import ConnectFailed
from holdfast.tools import finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.client import SyncClient
    from holdfast.tools.finding import Unit

ALL = 247
"""How many unit ids the standard has: with all asked, no other is rare."""


def find_units(url: str, asked: Sequence[int], timeout: float, delay: float, as_json: bool) -> None:
    """Finds unit ids, prints them, and exits with 1 if there are none."""
    if isinstance(parse(url), SerialTarget) and 0 in asked:
        raise click.UsageError("Unit id 0 is the broadcast on a serial line: nobody answers it.")
    if sys.stderr.isatty():
        most = len(asked) * (timeout + delay)
        click.echo(f"{len(asked)} unit ids, at most {most:.0f} s. Ctrl-C stops.", err=True)
    found: list[Unit] = []
    why = None
    ignores = False
    with device.connect(url, asked[0], timeout) as client:
        try:
            with bar("Finding", len(asked), lambda: f"{_count(found)} found") as advance:
                for unit in finding.units(client, asked, delay=delay):
                    found.append(unit)
                    if advance:
                        advance(len(found))
            ignores = _ignores(client, url, found)
        except ConnectFailed as error:
            device.fail(error, url, {"url": url} if as_json else None)
        except KeyboardInterrupt:
            why = "interrupted"
    left = asked[len(found) :]
    if as_json:
        told = {
            "ok": why is None and _count(found) > 0,
            "complete": why is None,
            "url": url,
            "ignores_unit": ignores,
            "asked": [each.unit for each in found],
            "not_asked": list(left),
            "units": [unit_told(each) for each in found if each.answers],
        }
        click.echo(json.dumps(told, indent=2))
    else:
        click.echo("\n".join(_units(url, found, left, ignores)))
        if why is not None:
            click.echo(f"holdfast: {url}: {why}", err=True)
    if why is not None or not _count(found):
        sys.exit(device.FAILED)


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
    rows = [
        (str(each.unit), each.detail, showing.plain(str(each.identity)))
        for each in found
        if each.answers
    ]
    lines = showing.table(("unit", "answer", "identification"), rows, "><<") if rows else []
    silent = [each.unit for each in found if not each.answers]
    lines += [""] if lines else []
    lines.append(f"{url}: {showing.counted(len(rows), 'unit id')} of {len(found)} asked answer")
    if silent:
        lines.append(f"no device: {listed(silent)}")
    if left:
        lines.append(f"not asked: {listed(left)}")
    if ignores:
        lines.append("The device answers every unit id: it probably ignores them.")
    return lines
