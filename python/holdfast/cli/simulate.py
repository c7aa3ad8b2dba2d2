"""`holdfast simulate`: a device with live values for the tags of a list."""

from __future__ import annotations

import math
import re
import shlex
import sys
import time
from contextlib import ExitStack
from fnmatch import fnmatchcase
from ipaddress import ip_address
from pathlib import Path
from random import Random
from secrets import token_hex
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import device, pace, showing, tag_options
from holdfast.cli.parsing import by
from holdfast.cli.signals import Signals
from holdfast.config.ip_addresses import parse_source
from holdfast.net.addresses import LOOPBACK, joined, reachable
from holdfast.protocol import MAX_UNIT
from holdfast.server import Server
from holdfast.simulation import HEATER, generators, playback
from holdfast.simulation.device import Refused, SimulatedDevice
from holdfast.simulation.faults import FaultProxy, Faults
from holdfast.tags.text import text_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from ipaddress import IPv4Address, IPv6Address

    from holdfast.net.addresses import Network
    from holdfast.simulation.generators import Generator
    from holdfast.tags import TagList

LAST_PORT = 65535
NOTICE = 0.1
"""Seconds within which a signal is noticed."""

FAILURE = 4
_SHARE = re.compile(r"[0-9]*\.?[0-9]+")


def parse_share(text: str) -> float:
    """Parses a share of requests. Raises `ValueError`."""
    if _SHARE.fullmatch(text) is None or not 0 <= float(text) <= 1:
        raise ValueError(f"{text!r} is not a share from 0 to 1, as in 0.05")
    return float(text)


def parse_exception(text: str) -> tuple[float, int]:
    """Parses SHARE[:CODE]. Raises `ValueError`."""
    share, colon, code = text.partition(":")
    number = int(code) if code.isascii() and code.isdigit() and len(code) < 4 else 0
    if colon and not 1 <= number <= 255:
        raise ValueError(f"{text!r} is not SHARE[:CODE] with a code from 1 to 255, as in 0.05:6")
    return parse_share(share), number if colon else FAILURE


def parse_latency(text: str) -> tuple[float, float]:
    """Parses SECONDS or MIN-MAX. Raises `ValueError`."""
    words = text.split("-")
    try:
        low, high = float(words[0]), float(words[-1])
    except ValueError:
        low = high = math.nan
    if len(words) > 2 or not 0 <= low <= high <= 60:
        raise ValueError(f"{text!r} is not SECONDS or MIN-MAX up to 60, as in 0.05-0.2")
    return low, high


@click.command(epilog="Example: holdfast simulate meter.yaml --set 'voltage*=sine:220:240:60'")
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path), required=False)
@click.option(
    "--profile", metavar="NAME", help="FILE is a configuration; simulate this profile of it."
)
@click.option(
    "--bind",
    type=by(ip_address),
    default="127.0.0.1",
    show_default=True,
    metavar="ADDRESS",
    help="Address to listen on.",
)
@click.option(
    "--port",
    type=click.IntRange(0, LAST_PORT),
    default=5020,
    show_default=True,
    metavar="N",
    help="Port of Modbus TCP; 0 lets the system pick one.",
)
@click.option(
    "--source",
    "sources",
    type=by(parse_source),
    multiple=True,
    metavar="NETWORK",
    help="Clients that may connect; repeatable. Default: this machine. Required if --bind is not a "
    "loopback address.",
)
@click.option(
    "--unit",
    type=click.IntRange(0, MAX_UNIT),
    default=1,
    show_default=True,
    metavar="N",
    help="Unit id.",
)
@click.option(
    "--set",
    "chosen",
    multiple=True,
    metavar="NAME=GENERATOR",
    help=f"What the values of a tag do: {generators.ALLOWED}. * stands for any text. Repeatable.",
)
@click.option(
    "--play",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Play back this CSV file, a row at a time, with a column for each tag.",
)
@click.option(
    "--every",
    type=device.seconds,
    default="1",
    show_default=True,
    metavar="SECONDS",
    help="Interval between values.",
)
@click.option("--seed", metavar="TEXT", help="The same seed gives the same values and faults.")
@click.option(
    "--latency",
    type=by(parse_latency),
    default="0",
    metavar="SECONDS",
    help="Delay of every reply, or MIN-MAX.",
)
@click.option(
    "--drop",
    type=by(parse_share),
    default="0",
    metavar="SHARE",
    help="Share of requests without a reply, 0 to 1.",
)
@click.option(
    "--exception",
    type=by(parse_exception),
    default="0",
    metavar="SHARE[:CODE]",
    help=f"Share of requests that an exception answers.  [default code: {FAILURE}]",
)
def simulate(
    file: Path | None,
    profile: str | None,
    bind: IPv4Address | IPv6Address,
    port: int,
    sources: tuple[Network, ...],
    unit: int,
    chosen: tuple[str, ...],
    play: Path | None,
    every: float,
    seed: str | None,
    latency: tuple[float, float],
    drop: float,
    exception: tuple[float, int],
) -> None:
    """Serve a simulated device over Modbus TCP, with live values for the tags of FILE.

    FILE is a tag list (YAML or CSV), or with --profile a configuration. Default: a small heater.
    The values of a tag follow its unit, states, and min and max, unless --set or --play choose
    others. Writable tags keep what is written to them. Only addresses of tags exist.

    Exit codes: 0 stopped by a signal, 1 can't listen, 2 wrong usage or an invalid FILE.
    """
    if not sources and not bind.is_loopback:
        raise click.UsageError(
            f"--bind {bind} is reachable from other machines: name the clients that may connect "
            "with --source NETWORK."
        )
    refuse, code = exception
    if drop + refuse > 1:
        raise click.UsageError("--drop and --exception are more than 1 together.")
    if file is None and profile is not None:
        raise click.UsageError("--profile needs FILE, a configuration.")
    tags = tag_options.tags_of(file or HEATER, profile)
    seed = token_hex(8) if seed is None else seed
    simulated = _device(tags, chosen, play, every, seed)
    faults = Faults(latency, drop, refuse, code)
    signals = Signals()
    with ExitStack() as running:
        try:
            where = _serve(
                running, simulated, (str(bind), port), unit, sources or LOOPBACK, faults, seed
            )
        except OSError as error:
            place = joined(str(bind), port)
            click.echo(f"holdfast: can't listen on {place}: {error.strerror or error}", err=True)
            sys.exit(device.FAILED)
        click.echo(_greeting(file, profile, tags, where, unit))

        def wait(seconds: float) -> None:
            if signals.received:
                raise _Stopped
            time.sleep(min(seconds, NOTICE))

        try:
            for tick in pace.ticks(every, wait=wait):
                if tick:
                    simulated.step()
        except _Stopped:
            pass


class _Stopped(Exception):
    """A signal has arrived."""


def _device(
    tags: TagList, chosen: Iterable[str], play: Path | None, every: float, seed: str
) -> SimulatedDevice:
    """Raises `click.UsageError` for what the tags can't do."""
    try:
        played = {} if play is None else playback.load(play, tags)
    except OSError as error:
        raise click.UsageError(f"{play}: {error.strerror}.") from error
    except playback.Unplayable as error:
        raise click.UsageError(f"{error}.") from error
    words = _chosen(tags, chosen)
    generators = {name: generator for name, (generator, _) in words.items()}
    try:
        return SimulatedDevice(
            tags, step=every, seed=seed, chosen=generators, played=played, warn=_warn
        )
    except Refused as error:
        if error.tag in played:
            raise click.UsageError(f"{play}: {error}.") from error
        where = f"--set {words[error.tag][1]}: " if error.tag in words else ""
        raise click.UsageError(f"{where}{error}.") from error


def _warn(message: str) -> None:
    click.echo(f"holdfast: {message}.", err=True)


def _chosen(tags: TagList, words: Iterable[str]) -> dict[str, tuple[Generator, str]]:
    """The generators of `--set`, and their words; a later one takes precedence."""
    found: dict[str, tuple[Generator, str]] = {}
    for word in words:
        pattern, sign, text = word.partition("=")
        if not sign:
            raise click.UsageError(f"--set: {word!r} is not NAME=GENERATOR.")
        named = [tag for tag in tags if fnmatchcase(tag.name, pattern)]
        if not named:
            raise click.UsageError(f"--set: no tag has the name {pattern!r}.")
        for tag in named:
            try:
                found[tag.name] = generators.parsed(tag, text), word
            except ValueError as error:
                raise click.UsageError(f"--set: {tag.name}: {error}.") from error
    return found


def _serve(
    running: ExitStack,
    simulated: SimulatedDevice,
    place: tuple[str, int],
    unit: int,
    sources: Sequence[Network],
    faults: Faults,
    seed: str,
) -> tuple[str, int]:
    """Starts to serve. Returns address and port. Raises `OSError`."""
    own = LOOPBACK if faults.any else sources
    rule = simulated.rule(unit, [str(network) for network in own])
    bind = ("127.0.0.1", 0) if faults.any else place
    server = running.enter_context(Server(rules=[rule], bind=joined(*bind)))
    if not faults.any:
        return server.address
    front = FaultProxy(place, server.address, faults, Random(f"{seed}:faults"), sources)
    return running.enter_context(front).address


def _greeting(
    file: Path | None, profile: str | None, tags: TagList, where: tuple[str, int], unit: int
) -> str:
    host, port = where
    url = f"tcp://{joined(reachable(host), port)}"
    served = f"{file or 'A heater'} is simulated at {url}, unit {unit}"
    lines = [f"{served}: {showing.counted(len(tags), 'tag')}.", "", "Try:", ""]
    lines += _unknown(url, unit) if file is None else _known(file, profile, tags, url, unit)
    return "\n".join([*lines, "", "Ctrl-C stops it."])


def _unknown(url: str, unit: int) -> list[str]:
    """Commands for a device without a tag list."""
    units = ["--units", unit] if unit != 1 else []
    one = ["--unit", unit] if unit != 1 else []
    describe = ["holdfast", "describe", url, *units, "--output", "heater.yaml"]
    watch = ["holdfast", "watch", url, "--tags", "heater.yaml", *one]
    return [f"  {shlex.join(map(str, command))}" for command in (describe, watch)]


def _known(file: Path, profile: str | None, tags: TagList, url: str, unit: int) -> list[str]:
    """Commands for a device with a tag list."""
    list_: list[Any] = ["--tags", file, *(["--profile", profile] if profile else [])]
    options = [*list_, *(["--unit", unit] if unit != 1 else [])]
    command = shlex.join(["holdfast", "watch", url, *map(str, options)])
    lines = [f"  {command}"]
    writable = next((tag for tag in tags if tag.writable and tag.is_number), None)
    if writable is not None:
        value = text_of(writable, generators.still(writable).items[0])
        write = ["holdfast", "write", url, f"{writable.name}={value}", *map(str, options)]
        lines.append(f"  {shlex.join(write)}")
    return lines
