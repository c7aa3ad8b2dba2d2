"""`holdfast watch` with tags: a live view, or lines for every change or reading."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import standard_output, terminal_text
from holdfast.cli.device_errors import fail, hint
from holdfast.cli.live import schedule
from holdfast.cli.live.sources import print_error
from holdfast.cli.tags import recording
from holdfast.cli.tags.changes import TagTracker, common_error
from holdfast.cli.tags.read import problem, value_shown
from holdfast.cli.terminal_text import print_json
from holdfast.tags.text import plain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.tags.changes import TagChange
    from holdfast.cli.tags.options import Form
    from holdfast.cli.tags.source import TagSource
    from holdfast.client.tag_reading import Reading


def watch_tags(source: TagSource, form: Form, every: float, times: int | None) -> None:
    """Watches tags. Exits with 1 if the device does not answer the first reading."""
    try:
        moment, first = source.read()
        error = common_error(first)
        if error is not None:
            fail(error, source.url, where=source.where)
        if form == "text" and standard_output.is_screen():
            from holdfast.cli.tags.view import TagView

            view = TagView(source, first, every)
            view.run(times)
            for each in view.tag_errors:
                hint(each, source.url)
        else:
            _lines(source, form, every, times, moment, first)
    except KeyboardInterrupt:
        pass


def _lines(
    source: TagSource,
    form: Form,
    every: float,
    times: int | None,
    moment: float,
    readings: Sequence[Reading],
) -> None:
    """Prints a line for every change, or with CSV for every reading."""
    click.echo(f"watching {source.where}", err=True)
    tracker = TagTracker(source.tags)
    if form == "csv":
        click.echo(recording.head(source.tags), nl=False)
    for tick in schedule.ticks(every, times):
        if tick:
            moment, readings = source.read()
        before = tracker.error
        changes = tracker.update(time.monotonic(), readings)
        if form == "csv":
            click.echo(recording.row(moment, readings, is_shown=sys.stdout.isatty()), nl=False)
        elif tracker.error is not None:
            if before is None:
                print_error(tracker.error, source.url)
        else:
            for change in changes:
                _print_change(change, source, form)


def _print_change(change: TagChange, source: TagSource, form: Form) -> None:
    tag, name = change.tag, terminal_text.plain(change.tag.name)
    if form == "json":
        fields: dict[str, Any] = {
            "ok": change.error is None,
            "target": source.url,
            "unit": source.unit,
            "time": terminal_text.timestamp(),
            "name": tag.name,
        }
        if change.error is not None:
            fields |= problem(change.error)
        else:
            fields |= {"was": plain(tag, change.was), "now": plain(tag, change.now)}
            state = tag.state(change.now)
            fields |= {} if state is None else {"state": state}
        print_json(fields)
        return
    if change.error is not None:
        click.echo(f"{terminal_text.clock()}  {name}: {change.error}")
        hint(change.error, source.url)
        return
    was = "" if change.was in (None, change.now) else f"{value_shown(tag, change.was)} -> "
    unit = f" {terminal_text.plain(tag.unit)}" if tag.unit and change.now is not None else ""
    click.echo(f"{terminal_text.clock()}  {name}: {was}{value_shown(tag, change.now)}{unit}")
