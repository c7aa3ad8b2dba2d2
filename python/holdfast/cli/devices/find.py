"""`holdfast find`: finds Modbus devices in networks, behind a gateway, or on a serial line."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from holdfast.cli.devices.find_hosts import (
    MAX_ADDRESSES,
    MAX_ADDRESSES_LARGE,
    check_size,
    find_hosts,
)
from holdfast.cli.devices.find_line import find_line
from holdfast.cli.devices.find_units import find_units
from holdfast.cli.options.duration import Duration, time_option, timeout_option
from holdfast.cli.options.option import DecimalNumber, flag, json_option, number_option, option
from holdfast.cli.options.units import unit_ids
from holdfast.cli.options.url import checked_url, is_serial_device, is_url
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import parse
from holdfast.config.values.ip_addresses import parse_source
from holdfast.discovery import device_search
from holdfast.discovery.line_search import BAUDS, PARITIES
from holdfast.net.addresses import LAST_PORT
from holdfast.protocol import MAX_SERIAL_UNIT, PORT

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.client.serial_settings import Parity
    from holdfast.net.addresses import Network

LINE_TIMEOUT_S = 0.5
RATES = DecimalNumber(0.1, 1000)
_PARITIES = "SERIAL: parities to try, always with one stop bit."
_UNITS_HELP = (
    "Unit ids to ask, as in 1-10,255.  [default: 1, 255 and 0 of each host of a NETWORK, "
    f"1-{MAX_SERIAL_UNIT} of a URL, 1-10 on a serial line]"
)


_ONLY_FOR = {
    **dict.fromkeys(("port", "rate", "large"), "NETWORK"),
    "delay": "URL",
    **dict.fromkeys(("bauds", "parities"), "SERIAL"),
}
"""The targets of parameters that not all have."""


def _bauds(text: str) -> tuple[int, ...]:
    found = tuple(int(part) for part in text.split(",") if re.fullmatch("[0-9]{2,7}", part))
    if len(found) != text.count(",") + 1 or not all(50 <= each <= 4_000_000 for each in found):
        raise click.BadParameter(f"{text!r} is not a list of bauds, as in 9600,19200.")
    return found


def _parities(text: str) -> tuple[Parity, ...]:
    found: tuple[Parity, ...] = tuple(each for each in PARITIES if each in text.split(","))
    if len(found) != text.count(",") + 1:
        raise click.BadParameter(f"{text!r} is not a list of {', '.join(PARITIES)}.")
    return found


@click.command(epilog="Example: holdfast find 192.168.0.0/24")
@click.argument("targets", nargs=-1, required=True, metavar="NETWORK...|URL|SERIAL")
@number_option("--port", "NETWORK: the TCP port of the devices.", 1, LAST_PORT, PORT)
@option("--rate", "N", "NETWORK: begin at most N connections a second.", RATES, 50)
@flag("--large", f"NETWORK: allow {MAX_ADDRESSES} to {MAX_ADDRESSES_LARGE} addresses.")
@option("--units asked", "LIST", _UNITS_HELP, unit_ids)
@option("--baud bauds", "LIST", "SERIAL: bauds to try.", _bauds, ",".join(map(str, BAUDS)))
@option("--parity parities", "LIST", _PARITIES, _parities, ",".join(PARITIES))
@time_option("--delay", "URL: wait between two requests.", "0", Duration(zero=True))
@timeout_option(None, f"Limit for each request.  [default: 1; {LINE_TIMEOUT_S} on a serial line]")
@json_option
def find(
    targets: tuple[str, ...],
    port: int,
    rate: float,
    large: bool,
    asked: tuple[int, ...] | None,
    bauds: tuple[int, ...],
    parities: tuple[Parity, ...],
    delay: float,
    timeout: float | None,
    as_json: bool,
) -> None:
    """Find Modbus devices by reading; nothing is written.

    NETWORK, as 192.168.0.0/24 or 192.168.0.7: the hosts that answer Modbus TCP. Only the addresses
    that you name are contacted. URL, as tcp://192.168.0.7: the unit ids that answer behind a
    gateway, or on a line whose settings are known. SERIAL, as /dev/ttyUSB0: the baud and parity of
    a line, then its unit ids. The search of a line ends with the first settings that work.

    A device answers if it returns a value or an exception to a read of holding register 0. It is
    then asked for its identification (functions 43/14 and 17).

    Ctrl-C prints the results so far.

    Exit codes: 0 a device was found; 1 none was, or the search ended early; 2 wrong usage.
    """
    if any("://" in each or is_serial_device(each) for each in targets):
        if len(targets) > 1:
            raise click.UsageError("Give one URL or one serial line, or several networks.")
        [target] = targets
        if "://" not in target:
            _refuse_options_of_others("SERIAL")
            find_line("rtu", target, asked, bauds, parities, timeout or LINE_TIMEOUT_S, as_json)
            return
        checked_url(target)
        parsed = parse(target)
        if isinstance(parsed, SerialTarget) and "?" not in target:
            _refuse_options_of_others("SERIAL")
            wait = timeout or LINE_TIMEOUT_S
            find_line(parsed.mode, parsed.device, asked, bauds, parities, wait, as_json)
            return
        _refuse_options_of_others("URL")
        find_units(target, asked or device_search.GATEWAY_UNITS, timeout or 1.0, delay, as_json)
        return
    _refuse_options_of_others("NETWORK")
    networks = _networks(targets, large)
    units = asked or device_search.HOST_UNITS
    find_hosts(" ".join(targets), networks, port, units, timeout or 1.0, rate, as_json)


def _refuse_options_of_others(kind: str) -> None:
    """Refuses options that have no effect on a target of this kind. Raises `click.UsageError`."""
    context = click.get_current_context()
    for param in context.command.params:
        name = str(param.name)
        whose = _ONLY_FOR.get(name, kind)
        if whose != kind and context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{param.opts[0]} is for {whose}, it can't be used with {kind}.")


def _networks(texts: Iterable[str], large: bool) -> list[Network]:
    networks = []
    for text in texts:
        try:
            networks.append(parse_source(text))
        except ValueError as error:
            if re.fullmatch(r"[0-9./:a-fA-F]+", text) and not is_url(text):
                raise click.UsageError(str(error)) from error
            raise click.UsageError(
                f"{text!r} is not a network (192.168.0.0/24), a URL or a serial line "
                f"(/dev/ttyUSB0). For the unit ids behind a host, type 'holdfast find tcp://{text}'."
                " The port of the hosts of a network is --port."
            ) from error
    check_size(networks, large=large)
    return networks
