"""`holdfast find SERIAL`: baud, parity and unit ids of a serial line."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, showing
from holdfast.cli.find_units import unit_told
from holdfast.cli.progress import bar
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
    why = None
    try:
        with bar("Finding", total, lambda: _tried(attempts)) as advance:
            for attempt in finding.line(mode, path, settings, units, timeout):
                attempts.append(attempt)
                if advance:
                    advance(len(attempts))
    except ConnectFailed as error:
        device.fail(error, path, {"device": path} if as_json else None)
    except KeyboardInterrupt:
        why = "interrupted"
    found = [each for each in attempts if each.found is not None and each.found.answers]
    if as_json:
        click.echo(json.dumps(_line_told(mode, path, attempts, found, total, why), indent=2))
    else:
        click.echo("\n".join(_line(mode, path, attempts, found, units)))
        if why is not None:
            click.echo(f"holdfast: {path}: {why}", err=True)
    if why is not None or not found:
        sys.exit(device.FAILED)


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
    mode: str,
    path: str,
    attempts: Sequence[Attempt],
    found: Sequence[Attempt],
    total: int,
    why: str | None,
) -> dict[str, object]:
    return {
        "ok": why is None and bool(found),
        "complete": why is None,
        "device": path,
        "attempts": len(attempts),
        "attempts_at_most": total,
        "garbled": _garbled(attempts),
        "unusable": _unusable(attempts),
        "units": [
            {"url": each.settings.url(mode, path), **unit_told(each.found)}
            for each in found
            if each.found is not None
        ],
    }


def _line(
    mode: str,
    path: str,
    attempts: Sequence[Attempt],
    found: Sequence[Attempt],
    units: Sequence[int],
) -> list[str]:
    rows = [
        (
            str(each.unit),
            each.settings.url(mode, path),
            each.detail,
            showing.plain(str(each.found.identity)) if each.found else "",
        )
        for each in found
    ]
    lines = []
    if rows:
        lines = [*showing.table(("unit", "url", "answer", "identification"), rows, "><<<"), ""]
    settings = {each.settings for each in attempts}
    lines.append(
        f"{path}: {showing.counted(len(rows), 'unit id')} found; unit ids asked: {listed(units)}, "
        f"{showing.counted(len(settings), 'setting')} tried"
    )
    if not found and _garbled(attempts):
        lines.append(
            f"Invalid bytes came at {', '.join(_garbled(attempts))}: a device with other settings, "
            "or noise on the line."
        )
    lines += [f"The port does not support {each}" for each in _unusable(attempts)[:3]]
    return lines
