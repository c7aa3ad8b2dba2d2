"""`holdfast watch` with tags: a live view, or lines for every change or reading."""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import device, pace, recording, showing
from holdfast.cli.tag_tracking import TagTracker, common_error
from holdfast.cli.tagged_read import problem, value_shown
from holdfast.tags.text import plain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.tag_source import TagSource
    from holdfast.cli.tag_tracking import TagChange
    from holdfast.cli.tagged_read import Form
    from holdfast.tools.tag_reading import Reading


def watch_tags(source: TagSource, form: Form, every: float, times: int | None) -> int:
    """Watches tags. Returns the exit code: 1 if the device does not answer the first reading."""
    try:
        moment, first = source.read()
        error = common_error(first)
        if error is not None:
            _fail(source, form, str(error))
            return device.FAILED
        if form == "text" and sys.stdout.isatty():
            from holdfast.cli.tag_view import TagView

            TagView(source, first, every).run(times)
        else:
            _lines(source, form, every, times, moment, first)
    except KeyboardInterrupt:
        pass
    return 0


def _fail(source: TagSource, form: Form, text: str) -> None:
    if form == "json":
        click.echo(json.dumps({"ok": False, "detail": f"{source.where}: {text}"}))
    else:
        click.echo(f"holdfast: {source.where}: {text}", err=True)


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
    for tick in pace.ticks(every, times):
        if tick:
            moment, readings = source.read()
        before = tracker.error
        changes = tracker.update(time.monotonic(), readings)
        if form == "csv":
            click.echo(recording.row(moment, readings), nl=False)
        elif tracker.error is not None:
            if before is None:
                _say_error(str(tracker.error), form)
        else:
            for change in changes:
                _say(change, form)


def _say(change: TagChange, form: Form) -> None:
    tag, name = change.tag, showing.plain(change.tag.name)
    if form == "json":
        told: dict[str, Any] = {"time": showing.timestamp(), "ok": change.error is None}
        told["name"] = tag.name
        if change.error is not None:
            told |= problem(change.error)
        else:
            told |= {"was": plain(tag, change.was), "now": plain(tag, change.now)}
            state = tag.state(change.now)
            told |= {} if state is None else {"state": state}
        click.echo(json.dumps(told))
        return
    if change.error is not None:
        click.echo(f"{showing.clock()}  {name}: {change.error}")
        return
    was = "" if change.was in (None, change.now) else f"{value_shown(tag, change.was)} -> "
    unit = f" {showing.plain(tag.unit)}" if tag.unit and change.now is not None else ""
    click.echo(f"{showing.clock()}  {name}: {was}{value_shown(tag, change.now)}{unit}")


def _say_error(text: str, form: Form) -> None:
    if form == "json":
        click.echo(json.dumps({"time": showing.timestamp(), "ok": False, "detail": text}))
    else:
        click.echo(f"{showing.clock()}  {text}")
