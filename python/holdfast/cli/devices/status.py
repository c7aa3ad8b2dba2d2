"""`holdfast describe status`: prints what a device says of its communication."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from holdfast.cli import device_errors
from holdfast.cli.devices.identify import answer_to_json, result_or_error, section
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options import device
from holdfast.cli.options.option import json_option
from holdfast.cli.options.url import url_argument
from holdfast.cli.terminal_text import print_json
from holdfast.errors import ModbusError

if TYPE_CHECKING:
    from holdfast.client.requests import EventLog


@click.command(epilog="Example: holdfast describe status tcp://192.168.0.10 --unit 3")
@url_argument
@device.device_options
@json_option
def status(url: str, unit: int, timeout: float, as_json: bool) -> None:
    """Print what the device at URL says of its communication.

    Requests the exception status (function 7), the event counter (function 11) and the event log
    (function 12). In the standard, they are functions of devices on serial lines; many devices
    support none.

    Exit codes: 0 the device supports at least one, 1 none, 2 wrong usage.
    """
    with device.connect(url, unit, timeout) as client:
        outputs = result_or_error(client.read_exception_status)
        counter = result_or_error(client.event_counter)
        log = result_or_error(client.event_log)
    answers = (outputs, counter, log)
    ok = not all(isinstance(each, ModbusError) for each in answers)
    if as_json:
        said = {
            "ok": ok,
            "target": url,
            "unit": unit,
            **(device_errors.problem(outputs) if not ok else {}),
            "exception_status": answer_to_json(outputs, lambda found: {"outputs": found}),
            "event_counter": answer_to_json(
                counter, lambda found: {"busy": found[0], "events": found[1]}
            ),
            "event_log": answer_to_json(log, _log_to_json),
        }
        print_json(said, indent=2)
    elif ok:
        sections = (
            section("Exception status (function 7)", outputs, _outputs),
            section("Event counter (function 11)", counter, _counter),
            section("Event log (function 12)", log, _log),
        )
        click.echo("\n\n".join(sections))
    else:
        for function, answer in zip((7, 11, 12), answers, strict=True):
            click.echo(f"holdfast: {url}: function {function}: {answer}", err=True)
    if not ok:
        sys.exit(ExitCode.FAILED)


def _outputs(found: int) -> list[tuple[str, str]]:
    return [(f"output {number}", "on" if found >> number & 1 else "off") for number in range(8)]


def _counter(found: tuple[bool, int]) -> list[tuple[str, str]]:
    return [("busy", "yes" if found[0] else "no"), ("events", str(found[1]))]


def _log(found: EventLog) -> list[tuple[str, str]]:
    return [
        *_counter((found.busy, found.events)),
        ("messages", str(found.messages)),
        ("latest first", found.log.hex(" ")),
    ]


def _log_to_json(found: EventLog) -> dict[str, object]:
    return {
        "busy": found.busy,
        "events": found.events,
        "messages": found.messages,
        "log": found.log.hex(),
    }
