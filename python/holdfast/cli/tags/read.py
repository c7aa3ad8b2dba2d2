"""`holdfast read` with tags: a table, CSV or JSON, once or repeatedly."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import answers, device_errors, terminal_text
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.live import schedule
from holdfast.cli.options.plc_addresses import modicon_hint
from holdfast.cli.tags import recording
from holdfast.cli.terminal_text import print_json
from holdfast.errors import ModbusError, RequestTimeout
from holdfast.tags.text import plain, text_of
from holdfast.values.orders import DEFAULT_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.tags.options import Form
    from holdfast.cli.tags.source import TagSource
    from holdfast.client.tag_reading import Error, Reading
    from holdfast.tags import Tag

NO_VALUE = "no value"


def read_tags(source: TagSource, form: Form, every: float | None, times: int | None) -> int:
    """Reads and prints tags, once or at every tick. Returns the exit code."""
    code = 0
    if form == "csv":
        click.echo(recording.head(source.tags), nl=False)
    try:
        for tick in schedule.ticks(every or 1, 1 if every is None else times):
            moment, readings = source.read()
            if any(each.error is not None for each in readings):
                code = ExitCode.FAILED
            if form == "csv":
                click.echo(recording.row(moment, readings, is_shown=sys.stdout.isatty()), nl=False)
                if every is None:
                    _explain(readings)
            elif form == "json":
                print_json(_to_json(source, readings, every is not None))
            else:
                if tick:
                    click.echo()
                if every is not None:
                    click.echo(terminal_text.clock())
                _show(source, readings)
            if form == "text" or (form == "csv" and every is None):
                for each in readings:
                    device_errors.hint(each.error, source.url, modicon_hint(each.tag))
            if every is None:
                _listen(source, readings)
    except KeyboardInterrupt:
        if every is None:
            raise
        if form == "text" and sys.stdout.isatty():
            click.echo()
    return code


def _listen(source: TagSource, readings: Sequence[Reading]) -> None:
    """Waits for a late reply to the last request that timed out."""
    late = [
        each.tag
        for each in readings
        if isinstance(each.error, RequestTimeout) and each.error.maybe_sent
    ]
    if late:
        source.listen(late[-1])


def _to_json(source: TagSource, readings: Sequence[Reading], timed: bool) -> dict[str, Any]:
    """A reading for JSON."""
    states = {each.tag.name: each.tag.state(each.value) for each in readings}
    errors = {each.tag.name: problem(each.error) for each in readings if each.error is not None}
    return {
        "ok": not errors,
        "target": source.url,
        "unit": source.unit,
        **({"time": terminal_text.timestamp()} if timed else {}),
        **answers.first_of(errors),
        "values": {each.tag.name: plain(each.tag, each.value) for each in readings},
        "states": {name: state for name, state in states.items() if state is not None},
        "errors": errors,
    }


def problem(error: Error) -> dict[str, object]:
    """The error of a tag for JSON."""
    if isinstance(error, ModbusError):
        return device_errors.problem(error)
    return {"reason": "undecodable", "detail": str(error)}


def value_shown(tag: Tag, value: Any) -> str:
    """A value for people, without its unit; a state with its number."""
    if value is None:
        return NO_VALUE
    state = tag.state(value)
    text = terminal_text.plain(text_of(tag, value))
    return text if state is None else f"{text} ({int(value)})"


def _show(source: TagSource, readings: Sequence[Reading]) -> None:
    """Prints a table; an error that all tags share is one line on standard error."""
    errors = {str(each.error) for each in readings}
    if len(errors) == 1 and readings[0].error is not None and len(readings) > 1:
        click.echo(f"holdfast: {source.url}: {errors.pop()}", err=True)
        return
    columns = {
        "name": [terminal_text.plain(each.tag.name) for each in readings],
        "value": [_cell(each) for each in readings],
        "unit": [terminal_text.plain(each.tag.unit) for each in readings],
        "address": [place(each.tag) for each in readings],
        "error": [_error(each) for each in readings],
    }
    for name in ("unit", "error"):
        if not any(columns[name]):
            del columns[name]
    rows = zip(*columns.values(), strict=True)
    click.echo("\n".join(terminal_text.table(list(columns), rows, "<>")))


def _cell(reading: Reading) -> str:
    return "?" if reading.error is not None else value_shown(reading.tag, reading.value)


def _error(reading: Reading) -> str:
    return "" if reading.error is None else terminal_text.styled(str(reading.error), fg="red")


def place(tag: Tag) -> str:
    """Place and type of a tag: `holding_registers 100 float32 CDAB`."""
    order = terminal_text.order_shown(tag)
    shown = "" if order in ("", DEFAULT_ORDER) else f" {order}"
    return f"{tag.area} {tag.address} {tag.type}{shown}"


def _explain(readings: Sequence[Reading]) -> None:
    """Prints why cells are empty."""
    for each in readings:
        if each.error is not None:
            click.echo(f"holdfast: {terminal_text.plain(each.tag.name)}: {each.error}", err=True)
