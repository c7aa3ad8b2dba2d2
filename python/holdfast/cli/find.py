"""`holdfast find`: finds Modbus devices in networks, behind a gateway, or on a serial line."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from holdfast.cli import device
from holdfast.cli.find_hosts import find_hosts
from holdfast.cli.find_line import find_line
from holdfast.cli.find_units import find_units
from holdfast.cli.unit_ids import unit_ids
from holdfast.client.url import SerialTarget, parse
from holdfast.config.ip_addresses import parse_source
from holdfast.net.addresses import LAST_PORT
from holdfast.protocol import PORT
from holdfast.tools import finding
from holdfast.tools.finding import BAUDS, PARITIES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.client.url import Parity
    from holdfast.net.addresses import Network

MAX_ADDRESSES = 1024
"""The most addresses without `--large`, and with it."""
MAX_LARGE = 65_536

UNITS = tuple(range(1, 248))
LINE_TIMEOUT = 0.5


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
@click.option(
    "--port",
    type=click.IntRange(1, LAST_PORT),
    default=PORT,
    show_default=True,
    metavar="PORT",
    help="NETWORK: the TCP port.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.1, 1000),
    default=50,
    show_default=True,
    metavar="N",
    help="NETWORK: begin at most N connections a second.",
)
@click.option(
    "--large",
    is_flag=True,
    help=f"NETWORK: allow more than {MAX_ADDRESSES} addresses, up to {MAX_LARGE}.",
)
@click.option(
    "--units",
    "asked",
    type=unit_ids,
    metavar="LIST",
    help="Unit ids to ask, as in 1-10,255.  [default: 1, 255 and 0 of each host of a NETWORK, "
    "1-247 of a URL, 1-10 on a serial line]",
)
@click.option(
    "--baud",
    "bauds",
    type=_bauds,
    default=",".join(map(str, BAUDS)),
    show_default=True,
    metavar="LIST",
    help="SERIAL: bauds to try.",
)
@click.option(
    "--parity",
    "parities",
    type=_parities,
    default=",".join(PARITIES),
    show_default=True,
    metavar="LIST",
    help="SERIAL: parities to try, always with one stop bit.",
)
@click.option(
    "--delay",
    type=device.pause,
    default="0",
    show_default=True,
    metavar="SECONDS",
    help="URL: wait between two requests.",
)
@click.option(
    "--timeout",
    type=device.seconds,
    metavar="SECONDS",
    help=f"Time limit for each request.  [default: 1; {LINE_TIMEOUT} on a serial line]",
)
@device.json_option
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
    if any("://" in each or device.SERIAL_DEVICE.fullmatch(each) for each in targets):
        if len(targets) > 1:
            raise click.UsageError("Give one URL or one serial line, or several networks.")
        [target] = targets
        if "://" not in target:
            find_line("rtu", target, asked, bauds, parities, timeout or LINE_TIMEOUT, as_json)
            return
        device.checked_url(target)
        parsed = parse(target)
        if isinstance(parsed, SerialTarget) and "?" not in target:
            wait = timeout or LINE_TIMEOUT
            find_line(parsed.mode, parsed.device, asked, bauds, parities, wait, as_json)
            return
        find_units(target, asked or UNITS, timeout or 1.0, delay, as_json)
        return
    networks = _networks(targets, large)
    units = asked or finding.HOST_UNITS
    find_hosts(networks, port, units, timeout or 1.0, rate, as_json)


def _networks(texts: Iterable[str], large: bool) -> list[Network]:
    networks = []
    for text in texts:
        try:
            networks.append(parse_source(text))
        except ValueError as error:
            if re.fullmatch(r"[0-9./:a-fA-F]+", text):
                raise click.UsageError(f"{text!r}: {error}.") from error
            raise click.UsageError(
                f"{text!r} is not a network (192.168.0.0/24), a URL or a serial line "
                f"(/dev/ttyUSB0). For the unit ids behind a host, type: holdfast find tcp://{text}"
            ) from error
    count = finding.size(networks)
    most = MAX_LARGE if large else MAX_ADDRESSES
    if count > most:
        raise click.UsageError(
            f"{count} addresses, allowed: {most}"
            + ("." if large else "; --large allows more. Name a smaller network, or several.")
        )
    return networks
