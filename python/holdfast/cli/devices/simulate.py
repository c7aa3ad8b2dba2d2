"""`holdfast simulate`: a device with live values for the tags of a list."""

from __future__ import annotations

import re
import time
from contextlib import ExitStack
from fnmatch import fnmatchcase
from pathlib import Path
from random import Random
from secrets import token_hex
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import terminal_text
from holdfast.cli.exit_codes import fail
from holdfast.cli.live import schedule
from holdfast.cli.options.bind_and_source import (
    bind_option,
    require_source,
    source_option,
    unbindable,
)
from holdfast.cli.options.device import unit_option
from holdfast.cli.options.duration import Duration, every_option
from holdfast.cli.options.option import FILE, file_option, option, parsed_by
from holdfast.cli.shell_command import shell_command
from holdfast.cli.signals import SIGNAL_INTERVAL_S, Signals
from holdfast.cli.tags.files import tags_of
from holdfast.events.writer import announce
from holdfast.net.addresses import LOOPBACK, joined, reachable
from holdfast.runtime.suggestion import suggestion
from holdfast.server import Server
from holdfast.simulation import HEATER, generators, playback, usual_values
from holdfast.simulation.device import Refused, SimulatedDevice
from holdfast.simulation.faults import FaultProxy, Faults
from holdfast.tags.text import text_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config.values.ip_addresses import Bind
    from holdfast.net.addresses import Network
    from holdfast.simulation.generators import Generator
    from holdfast.tags import TagList

MAX_EXCEPTION = 0xFF
DEFAULT_EXCEPTION = 4
_SHARE = re.compile(r"[0-9]*\.?[0-9]+")
_LATENCY = Duration(most_s=60, zero=True)


def parse_share(text: str) -> float:
    """Parses a share of requests. Raises `ValueError`."""
    if _SHARE.fullmatch(text) is None or not 0 <= float(text) <= 1:
        raise ValueError(f"{text!r} is not a share from 0 to 1, as in 0.05")
    return float(text)


def parse_exception(text: str) -> tuple[float, int]:
    """Parses SHARE[:CODE]. Raises `ValueError`."""
    share, colon, code = text.partition(":")
    number = int(code) if code.isascii() and code.isdigit() and len(code) < 4 else 0
    if colon and not 1 <= number <= MAX_EXCEPTION:
        allowed = f"a code from 1 to {MAX_EXCEPTION}, as in 0.05:6"
        raise ValueError(f"{text!r} is not SHARE[:CODE] with {allowed}")
    return parse_share(share), number if colon else DEFAULT_EXCEPTION


def parse_latency(text: str) -> tuple[float, float]:
    """Parses TIME or MIN-MAX."""
    first, dash, last = text.partition("-")
    least, most = (_LATENCY.convert(each, None, None) for each in (first, last if dash else first))
    if least > most:
        raise ValueError(f"{text!r} is not TIME or MIN-MAX, as in 50ms-200ms")
    return least, most


_SET = f"What the values of a tag do: {generators.ALLOWED}. * stands for any text. Repeatable."
_EXCEPTION = f"Share of requests with an exception.  [default code: {DEFAULT_EXCEPTION}]"


@click.command(epilog="Example: holdfast simulate meter.yaml --set 'voltage*=sine:220:240:60'")
@click.argument("file", type=FILE, required=False)
@option("--profile", "NAME", "FILE is a configuration; simulate this profile of it.")
@bind_option(5020, "Address and port of the Modbus TCP listener; port 0 lets the system pick one.")
@source_option
@unit_option()
@option("--set chosen", "NAME=GENERATOR", _SET, multiple=True)
@file_option("--play", "Play back this CSV file, a row at a time, with a column for each tag.")
@every_option("1", "Interval between values.")
@option("--seed", "TEXT", "The same seed gives the same values and faults.")
@option("--latency", "TIME", "Delay of every reply, or MIN-MAX.", parsed_by(parse_latency), "0")
@option("--drop", "SHARE", "Share of requests without reply, 0 to 1.", parsed_by(parse_share), "0")
@option("--exception", "SHARE[:CODE]", _EXCEPTION, parsed_by(parse_exception), "0")
def simulate(
    file: Path | None,
    profile: str | None,
    bind: Bind,
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
    require_source(bind, sources)
    refuse, code = exception
    if drop + refuse > 1:
        raise click.UsageError("--drop and --exception are more than 1 together.")
    if file is None and profile is not None:
        raise click.UsageError("--profile needs FILE, a configuration.")
    tags = tags_of(file or HEATER, profile)
    seed = token_hex(8) if seed is None else seed
    simulated = _device(tags, chosen, play, every, seed)
    faults = Faults(latency, drop, refuse, code)
    signals = Signals()
    allowed = sources or LOOPBACK
    with ExitStack() as running:
        try:
            host, port = _serve(running, simulated, bind, unit, allowed, faults, seed)
        except OSError as error:
            fail(f"{unbindable(bind, error)}; --bind sets another address or port")
        url = f"tcp://{joined(reachable(host, allowed), port)}"
        announce(_greeting(file, profile, tags, url, unit))

        def wait(seconds: float) -> None:
            if signals.received:
                raise _Stopped
            time.sleep(min(seconds, SIGNAL_INTERVAL_S))

        try:
            for tick in schedule.ticks(every, wait=wait):
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
        played = playback.Played({}, []) if play is None else playback.load(play, tags)
    except OSError as error:
        raise click.UsageError(f"{play}: {error.strerror}") from error
    except playback.Unplayable as error:
        raise click.UsageError(str(error)) from error
    words = _chosen(tags, chosen)
    generators = {name: generator for name, (generator, _) in words.items()}
    try:
        return SimulatedDevice(
            tags, step=every, seed=seed, chosen=generators, played=played.values, warn=_warn
        )
    except Refused as error:
        if error.row is not None:
            raise click.UsageError(f"{play}:{played.lines[error.row]}: {error}") from error
        where = f"--set {words[error.tag][1]}: " if error.tag in words else ""
        raise click.UsageError(f"{where}{error}") from error


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
            near = suggestion(pattern, [tag.name for tag in tags])
            raise click.UsageError(f"--set: no tag has the name {pattern!r}{near}")
        for tag in named:
            try:
                found[tag.name] = generators.parsed(tag, text), word
            except ValueError as error:
                raise click.UsageError(f"--set: {tag.name}: {error}") from error
    return found


def _serve(
    running: ExitStack,
    simulated: SimulatedDevice,
    bind: Bind,
    unit: int,
    sources: Sequence[Network],
    faults: Faults,
    seed: str,
) -> tuple[str, int]:
    """Starts to serve. Returns address and port. Raises `OSError`."""
    own = LOOPBACK if faults.any else sources
    rule = simulated.rule(unit, [str(network) for network in own])
    place = "127.0.0.1:0" if faults.any else str(bind)
    server = running.enter_context(Server(rules=[rule], bind=place, event_log=True))
    if not faults.any:
        return server.address
    front = FaultProxy(
        (bind.host, bind.port), server.address, faults, Random(f"{seed}:faults"), sources
    )
    return running.enter_context(front).address


def _greeting(file: Path | None, profile: str | None, tags: TagList, url: str, unit: int) -> str:
    served = f"{file or 'A heater'} is simulated at {url}, unit {unit}"
    lines = [f"{served}: {terminal_text.counted(len(tags), 'tag')}.", "", "Try:", ""]
    lines += _unknown(url, unit) if file is None else _known(file, profile, tags, url, unit)
    return "\n".join([*lines, "", "Ctrl-C stops it."])


def _unknown(url: str, unit: int) -> list[str]:
    """Commands for a device without a tag list."""
    units = ["--units", unit] if unit != 1 else []
    one = ["--unit", unit] if unit != 1 else []
    describe = ["holdfast", "describe", url, *units, "--output", "heater.yaml"]
    watch = ["holdfast", "watch", url, "--tags", "heater.yaml", *one]
    return [f"  {shell_command(*command)}" for command in (describe, watch)]


def _known(file: Path, profile: str | None, tags: TagList, url: str, unit: int) -> list[str]:
    """Commands for a device with a tag list."""
    list_: list[Any] = ["--tags", file, *(["--profile", profile] if profile else [])]
    options = [*list_, *(["--unit", unit] if unit != 1 else [])]
    command = shell_command("holdfast", "watch", url, *options)
    lines = [f"  {command}"]
    writable = next((tag for tag in tags if tag.writable and tag.is_number), None)
    if writable is not None:
        value = text_of(writable, usual_values.still(writable).items[0])
        write = ["holdfast", "write", url, f"{writable.name}={value}", *options]
        lines.append(f"  {shell_command(*write)}")
    return lines
