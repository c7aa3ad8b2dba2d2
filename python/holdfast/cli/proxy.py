"""`holdfast proxy`: passes requests on to a device or a serial line, without a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from holdfast.cli.device import checked_url, usable
from holdfast.cli.log_options import log_config, log_options
from holdfast.cli.parsing import by
from holdfast.cli.run import serve
from holdfast.client.endpoint import endpoint
from holdfast.client.url import MAX_IN_FLIGHT, SerialTarget, parse
from holdfast.config import Config
from holdfast.config.ip_addresses import parse_bind, parse_source
from holdfast.config.scalars import MAX_TIME, MIN_TIME
from holdfast.net.addresses import LOOPBACK, joined, reachable
from holdfast.protocol import (
    CODES,
    MAX_CODE,
    MAX_SERIAL_UNIT,
    MAX_UNIT,
    OTHER_READS,
    WRITING_CODES,
)

if TYPE_CHECKING:
    from holdfast.appliance import Appliance
    from holdfast.client.url import Target
    from holdfast.config.ip_addresses import Bind
    from holdfast.logs import Format
    from holdfast.net.addresses import Network

LISTENER = "proxy"
LINK = "link"
DEVICE = "device"
"""Names in the configuration, which logs and counters show."""


def parse_seconds(text: str) -> float:
    """Parses a time. Raises `ValueError` for one that a configuration does not allow."""
    allowed = f"{text!r} is not a number of seconds from {MIN_TIME} to {MAX_TIME}"
    try:
        number = float(text)
    except ValueError:
        raise ValueError(allowed) from None
    if not MIN_TIME <= number <= MAX_TIME:
        raise ValueError(allowed)
    return number


def parse_cache(text: str) -> float:
    """Parses a time that can be 0."""
    return 0.0 if text == "0" else parse_seconds(text)


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
            raise ValueError(f"function {code} is listed twice")
        codes.append(code)
    return codes


@click.command(epilog="Example: holdfast proxy 'rtu:///dev/ttyUSB0?baud=9600' --read-only")
@click.argument("url", type=checked_url, metavar="DEVICE-URL")
@click.option(
    "--listen",
    type=by(parse_bind),
    default="127.0.0.1:5020",
    show_default=True,
    metavar="ADDRESS:PORT",
    help="Address and port of the Modbus TCP listener.",
)
@click.option(
    "--source",
    "sources",
    type=by(parse_source),
    multiple=True,
    metavar="NETWORK",
    help="Clients that may connect; repeatable. Default: this machine. Required if --listen is not "
    "a loopback address.",
)
@click.option("--read-only", is_flag=True, help="Refuse all requests that may write.")
@click.option(
    "--functions",
    type=by(parse_functions),
    metavar="LIST",
    help="Pass on only these function codes, as in 3,4,65. Default: all of the standard.",
)
@click.option(
    "--unit",
    type=click.IntRange(0, MAX_UNIT),
    metavar="N",
    help="Send all requests to unit N. Default: unit ids pass through.",
)
@click.option(
    "--timeout",
    type=by(parse_seconds),
    default="1",
    show_default=True,
    metavar="SECONDS",
    help="Time limit for a request to the device and its reply.",
)
@click.option(
    "--in-flight",
    type=by(parse_in_flight),
    default="1",
    show_default=True,
    metavar="N",
    help="Requests in flight to the device, over TCP and TLS; auto: more while replies stay fast.",
)
@click.option(
    "--cache",
    type=by(parse_cache),
    default="0",
    show_default=True,
    metavar="SECONDS",
    help="Time for which a reply answers equal reads.",
)
@log_options
def proxy(
    url: str,
    listen: Bind,
    sources: tuple[Network, ...],
    read_only: bool,
    functions: list[int] | None,
    unit: int | None,
    timeout: float,
    in_flight: int | str,
    cache: float,
    log_format: Format,
    json_log: bool,
) -> None:
    """Serve the device at DEVICE-URL to many Modbus TCP clients.

    All clients share one connection or serial line to the device. Requests are sent one after
    another, writes first; equal reads that wait are sent once. The device can be at any URL:
    tcp://host:502, rtu:///dev/ttyUSB0?baud=19200&parity=even, rtu+tcp://host:4001 and others.

    Unit ids pass through: 0 to 255 to a network address, 1 to 247 to a serial line, where requests
    to 0 are broadcast and have no reply. With --unit, all unit ids lead to one device.

    On SIGHUP, the TLS files in DEVICE-URL are read anew. This is `holdfast run` with one listener
    and one link. A configuration file allows more listeners, rules and devices.

    Exit codes: 0 stopped by a signal, 1 can't listen, 2 wrong usage.
    """
    target = parse(url)
    with usable():
        endpoint(target)
    _check(target, listen, sources, functions, unit, read_only=read_only)
    rule: dict[str, Any] = {
        "sources": list(sources or LOOPBACK),
        "access": "read-only" if read_only else "read-write",
        "units": _units(target, unit),
    }
    if functions is not None:
        rule["functions"] = functions
    link = {"url": url, "timeout": timeout, "in_flight": in_flight, "cache": cache}
    shared = {key: link[key] for key in ("url", "timeout", "in_flight")}
    config = Config.model_validate(
        {
            "links": {LINK: link},
            "devices": {} if unit is None else {DEVICE: {**shared, "unit": unit}},
            "listeners": {LISTENER: {"type": "modbus-tcp", "bind": listen, "rules": [rule]}},
            "log": log_config(log_format, json_log),
        }
    )
    serve(
        config,
        lambda appliance: _greeting(appliance, config, target, unit),
        named="proxy",
        load=lambda: config,  # The files in the URL are read anew.
    )


def _check(
    target: Target,
    listen: Bind,
    sources: tuple[Network, ...],
    functions: list[int] | None,
    unit: int | None,
    *,
    read_only: bool,
) -> None:
    """Raises `click.UsageError` for options that do not fit together."""
    if not sources and not listen.address.is_loopback:
        raise click.UsageError(
            f"--listen {listen} is reachable from other machines: name the clients that may "
            "connect with --source NETWORK."
        )
    if isinstance(target, SerialTarget) and unit is not None and not 1 <= unit <= MAX_SERIAL_UNIT:
        raise click.UsageError(f"--unit on a serial line is 1 to {MAX_SERIAL_UNIT}, not {unit}.")
    for code in functions or () if read_only else ():
        if code in WRITING_CODES or code not in (*CODES, *OTHER_READS):
            raise click.UsageError(f"--functions {code} may write: omit it, or --read-only.")


def _units(target: Target, unit: int | None) -> dict[int | str, dict[str, str]]:
    if unit is not None:
        return {key: {"route": DEVICE} for key in range(MAX_UNIT + 1)}
    last = MAX_SERIAL_UNIT if isinstance(target, SerialTarget) else MAX_UNIT
    return {f"0-{last}": {"route": LINK}}


def _greeting(appliance: Appliance, config: Config, target: Target, unit: int | None) -> str:
    [listening] = appliance.endpoints()
    assert listening.port is not None
    listener = config.listeners[LISTENER]
    assert listener.type == "modbus-tcp"
    [rule] = listener.rules
    key = next(iter(rule.units))
    units = f"unit ids {key} pass through" if unit is None else f"all unit ids are unit {unit}"
    url = f"tcp://{joined(reachable(listening.host), listening.port)}"
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
