"""`holdfast proxy`: passes requests on to a device or a serial line, without a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_args

import click

from holdfast._core import MAX_IN_FLIGHT
from holdfast.cli.options.bind_and_source import bind_option, require_source, source_option
from holdfast.cli.options.device import unit_option, usable
from holdfast.cli.options.duration import Duration, time_option, timeout_option
from holdfast.cli.options.log_lines import log_format_option
from holdfast.cli.options.option import choice, option, parsed_by
from holdfast.cli.options.units import refuse_broadcast
from holdfast.cli.options.url import checked_url
from holdfast.cli.services.run import serve
from holdfast.client.base import is_broadcast
from holdfast.client.endpoint import endpoint
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import IN_FLIGHT, parse
from holdfast.config import Config
from holdfast.config.values.scalars import MAX_TIME, MIN_TIME
from holdfast.net.addresses import LOOPBACK, joined, reachable
from holdfast.protocol import (
    CODES,
    MAX_CODE,
    MAX_SERIAL_UNIT,
    MAX_UNIT,
    WRITING_CODES,
)
from holdfast.types import Access

if TYPE_CHECKING:
    from holdfast.appliance import Appliance
    from holdfast.client.url import Target
    from holdfast.config.values.ip_addresses import Bind
    from holdfast.events import Format
    from holdfast.net.addresses import Network

TIME = Duration(MIN_TIME, MAX_TIME)
TIME_OR_NONE = Duration(MIN_TIME, MAX_TIME, zero=True)
_FUNCTIONS = "Pass on only these function codes, as in 3,4,65. Default: all of the standard."
_IN_FLIGHT = "Requests in flight to the device, over TCP and TLS; auto: more while it is fast."
LISTENER = "proxy"
LINK = "link"
DEVICE = "device"
"""Names in the configuration, which logs and counters show."""


def parse_in_flight(text: str) -> int | str:
    """Parses a number of requests, or `auto`."""
    if text == "auto":
        return text
    number = int(text) if text.isascii() and text.isdigit() else 0
    if not 1 <= number <= MAX_IN_FLIGHT:
        raise ValueError(f"{text!r} is not auto or a number from 1 to {MAX_IN_FLIGHT}")
    return number


def parse_functions(text: str) -> list[int]:
    """Parses function codes, separated by commas."""
    codes: list[int] = []
    for word in text.split(","):
        code = int(word) if word.strip().isascii() and word.strip().isdigit() else 0
        if not 1 <= code <= MAX_CODE:
            raise ValueError(f"{word.strip()!r} is not a function code from 1 to {MAX_CODE}")
        if code in codes:
            raise ValueError(f"function {code} is given twice")
        codes.append(code)
    return codes


@click.command(epilog="Example: holdfast proxy 'rtu:///dev/ttyUSB0?baud=9600' --access read-only")
@click.argument("url", type=checked_url, metavar="DEVICE-URL")
@bind_option(5050, "Address and port of the Modbus TCP listener.")
@source_option
@choice("--access", "read-only: refuse requests that may write.", get_args(Access), "read-write")
@option("--functions", "LIST", _FUNCTIONS, parsed_by(parse_functions))
@unit_option(None, "Send all requests to unit N. Default: unit ids pass through.")
@timeout_option(help="Time limit for a request to the device and its reply.", type=TIME)
@option("--in-flight", "N", _IN_FLIGHT, parsed_by(parse_in_flight), "1")
@time_option("--cache", "Time for which a reply answers identical reads.", "0", TIME_OR_NONE)
@log_format_option
def proxy(
    url: str,
    bind: Bind,
    sources: tuple[Network, ...],
    access: Access,
    functions: list[int] | None,
    unit: int | None,
    timeout: float,
    in_flight: int | str,
    cache: float,
    log_format: Format,
) -> None:
    """Serve the device at DEVICE-URL to many Modbus TCP clients.

    All clients share one connection or serial line to the device. Requests are sent one after
    another, writes first; identical reads that wait are sent once. The device can be at any URL:
    tcp://host:502, rtu:///dev/ttyUSB0?baud=19200&parity=even, rtu+tcp://host:4001 and others.

    Unit ids pass through: 0 to 255 to a network address, 1 to 247 to a serial line, where requests
    to 0 are broadcast and have no reply. With --unit, all unit ids lead to one device, 1 to 255 on
    a serial line.

    On SIGHUP, the TLS files in DEVICE-URL are read anew. This is `holdfast run` with one listener
    and one link. A configuration file allows more listeners, rules and devices.

    Exit codes: 0 stopped by a signal, 1 can't listen, 2 wrong usage.
    """
    target = parse(url)
    is_line = isinstance(target, SerialTarget)
    with usable():
        endpoint(target)
    require_source(bind, sources)
    if unit is not None and is_broadcast(target, unit):
        refuse_broadcast([unit])
    for code in functions or () if access == "read-only" else ():
        if code in WRITING_CODES or code not in CODES:
            raise click.UsageError(f"--functions {code} may write: omit it, or --access read-only.")
    one = isinstance(target, SerialTarget) or target.transport not in IN_FLIGHT
    if one and in_flight not in (1, "auto"):
        raise click.UsageError(f"--in-flight {in_flight} requires {' or '.join(IN_FLIGHT)}.")
    rule: dict[str, Any] = {
        "sources": list(sources or LOOPBACK),
        "access": access,
        "units": _units(MAX_SERIAL_UNIT if is_line else MAX_UNIT, unit),
    }
    if functions is not None:
        rule["functions"] = functions
    link = {"url": url, "timeout": timeout, "in_flight": in_flight, "cache": cache}
    shared = {key: link[key] for key in ("url", "timeout", "in_flight")}
    config = Config.model_validate(
        {
            "links": {LINK: link},
            "devices": {} if unit is None else {DEVICE: {**shared, "unit": unit}},
            "listeners": {LISTENER: {"type": "modbus-tcp", "bind": bind, "rules": [rule]}},
            "log": {"format": log_format},
        }
    )
    serve(
        config,
        lambda appliance: _greeting(appliance, config, target, unit),
        load=lambda: config,  # The files in the URL are read anew.
    )


def _units(last: int, unit: int | None) -> dict[int | str, dict[str, str]]:
    """All unit ids lead to the device, or those up to the last one to the link."""
    if unit is not None:
        return {key: {"route": DEVICE} for key in range(MAX_UNIT + 1)}
    return {f"0-{last}": {"route": LINK}}


def _greeting(appliance: Appliance, config: Config, target: Target, unit: int | None) -> str:
    [listening] = appliance.endpoints()
    assert listening.port is not None
    listener = config.listeners[LISTENER]
    assert listener.type == "modbus-tcp"
    [rule] = listener.rules
    key = next(iter(rule.units))
    units = f"unit ids {key} pass through" if unit is None else f"all unit ids are unit {unit}"
    url = f"tcp://{joined(reachable(listening.host, rule.sources), listening.port)}"
    sources = ", ".join(map(str, rule.sources))
    return "\n".join(
        [
            f"{target} is served at {url}:",
            "",
            f"  {units}; {rule.access} for {sources}",
            "",
            "Try:",
            "",
            f"  holdfast read {url} hr 0 --unit {1 if unit is None else unit}",
            "",
            "Ctrl-C stops it.",
        ]
    )
