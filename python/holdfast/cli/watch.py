"""`holdfast watch`: a live view of a device, or of the memories of an appliance."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

from holdfast.cli import (
    device,
    pace,
    places,
    showing,
    sources,
    tag_options,
    tag_source,
    tagged_watch,
)
from holdfast.cli.configuration import WRONG, load_or_exit
from holdfast.cli.progress import bar
from holdfast.cli.sources import Unreadable, Unwatchable, WatchedRange
from holdfast.cli.tag_options import TagFiles
from holdfast.cli.tagged_read import form_of
from holdfast.cli.watching import Tracker
from holdfast.errors import ModbusError
from holdfast.protocol import ADDRESSES, LAST_ADDRESS
from holdfast.tools import discovery
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.places import Place
    from holdfast.cli.sources import Source
    from holdfast.cli.watching import Change

TOKEN = "HOLDFAST_TOKEN"


@click.command(epilog="Example: holdfast watch plant.yaml")
@click.argument("target", metavar="URL|FILE")
@click.argument(
    "words",
    nargs=-1,
    metavar="[AREA ADDRESS [COUNT] | AREA:ADDRESS[:TYPE[:ORDER]]...]",
    shell_complete=places.complete,
)
@click.option("--memory", metavar="NAME", help="With FILE: only this memory.")
@click.option(
    "--every",
    type=device.seconds,
    default="1",
    show_default=True,
    metavar="SECONDS",
    help="Interval between readings.",
)
@click.option(
    "--times", "--count", type=click.IntRange(1), metavar="N", help="Stop after N readings."
)
@tag_options.tag_options
@tag_options.output_options
@click.option("--modicon", is_flag=True, help="ADDRESS is a Modicon number, as in 40001 or 4x0001.")
@device.device_options
@device.json_option
def watch(
    target: str,
    words: tuple[str, ...],
    memory: str | None,
    every: float,
    times: int | None,
    tag_file: Path | None,
    profile: str | None,
    config_file: Path | None,
    only: tuple[str, ...],
    max_gap: int,
    as_csv: bool,
    record: Path | None,
    modicon: bool,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Watch a device, or the memories of a running appliance; nothing is written.

    With URL, reads COUNT addresses (default: 1) from AREA of the device, starting at ADDRESS.
    Without AREA, reads all addresses that `holdfast map` finds.

    With AREA:ADDRESS, reads several values, each with a type and order of its own, as in
    hr:0:float32 hr:10:uint32:CDAB coil:3. With --tags, reads the tags of a list.

    With FILE, the configuration of an appliance on this machine, reads its memories over its REST
    interface (with the token in HOLDFAST_TOKEN), or else over its first listener of type
    modbus-tcp.

    On a terminal, shows all values, with changes highlighted, and rates of change. q quits, n and p
    turn pages. Without a terminal, or with --json, prints a line for every change; with --csv, a
    line for every reading.

    Exit codes: 0 ended by q or Ctrl-C, 1 the first reading failed, 2 wrong usage.
    """
    files = TagFiles(tag_file, profile, config_file)
    if device.is_url(target) or config_file is not None:
        untyped = (None, "ABCD", None)
        of = tag_options.device_of(files, target, words, only, untyped, modicon, unit, timeout)
        if of is not None:
            of = replace(of, url=device.checked_url(of.url))
            if memory is not None:
                raise click.UsageError("--memory requires FILE.")
            form = form_of(as_json, as_csv)
            with tag_source.opened(of, max_gap, record) as tagged:
                sys.exit(tagged_watch.watch_tags(tagged, form, every, times))
    elif files.given or tag_options.are_items(words):
        raise click.UsageError("AREA:ADDRESS and --tags require URL, not FILE.")
    tag_options.require_tags(as_csv=as_csv, record=record, only=only, max_gap=max_gap)
    url = device.is_url(target)
    if url and memory is not None:
        raise click.UsageError("--memory requires FILE.")
    chosen = _chosen(words, modicon)
    if url:
        source = _device(device.checked_url(target), chosen, unit, timeout, as_json)
    else:
        source = _appliance(Path(target), memory, chosen, timeout)
    source.blocks, missing = sources.cut(source.blocks)
    note = f"{showing.counted(missing, 'more address')} are not watched" if missing else None
    try:
        try:
            first = source.read()
        except (ModbusError, Unreadable, OSError) as error:
            _fail(f"{source.where}: {error}", as_json)
        if sys.stdout.isatty() and not as_json:
            from holdfast.cli.live import View

            View(source, first, every, note).run(times)
        else:
            click.echo(f"watching {source.where}{f'; {note}' if note else ''}", err=True)
            _lines(source, first, every, times, as_json)
    except KeyboardInterrupt:
        pass
    finally:
        source.close()


def _chosen(words: Sequence[str], modicon: bool) -> tuple[Place, int] | None:
    """The requested place and count, or `None`."""
    if not words:
        return None
    place, left = places.taken(words, modicon=modicon)
    count = places.counted(left)
    if place.address + count > ADDRESSES:
        raise click.UsageError(
            f"{count} from address {place.address}: the last address is {LAST_ADDRESS}."
        )
    return place, count


def _device(
    url: str, chosen: tuple[Place, int] | None, unit: int, timeout: float, as_json: bool
) -> Source:
    """The blocks of a device: the requested block, or all that exist."""
    client = device.connect(url, unit, timeout)
    where = f"{url}, unit {unit}"
    if chosen is not None:
        place, count = chosen
        return sources.DeviceSource(
            where, client, [WatchedRange(None, unit, place.area, place.address, count)]
        )
    survey = discovery.Survey(dense=False)
    click.echo(f"{where}: searching for addresses", err=True)
    try:
        with bar("Mapping", survey.total, lambda: f"{survey.requests} requests") as advance:
            discovery.run_sync(survey, client, advance and (lambda survey: advance(survey.at)))
    except ModbusError as error:
        client.close()
        _fail(f"{url}: {error}", as_json)
    blocks = [
        WatchedRange(None, unit, found.area, each.start, len(each))
        for found in survey.areas
        for each in found.ranges
    ]
    if not blocks:
        client.close()
        _fail(f"{url}: no address was found", as_json)
    return sources.DeviceSource(where, client, blocks)


def _appliance(
    file: Path, memory: str | None, chosen: tuple[Place, int] | None, timeout: float
) -> Source:
    """The memories of an appliance, read over REST or Modbus TCP."""
    config = load_or_exit(file)
    token = os.environ.get(TOKEN)
    if memory is not None and memory not in config.memories:
        names = ", ".join(config.memories)
        raise click.UsageError(f"{file} has no memory {memory!r}, allowed: {names}.")
    try:
        if config.rest is not None:
            blocks = sources.by_rest(config, token)
        else:
            name, bind, blocks = sources.by_modbus(config)
    except Unwatchable as error:
        click.echo(f"{file}: {error}", err=True)
        sys.exit(WRONG)
    if memory is not None:
        blocks = [block for block in blocks if block.memory == memory]
    if chosen is not None:
        place, count = chosen
        blocks = sources.within(blocks, place.area, place.address, count)
    if not blocks:
        click.echo(f"{file}: none of the requested addresses can be read", err=True)
        sys.exit(WRONG)
    if config.rest is not None:
        needed = None if config.rest.tokens == "none" else token
        return sources.Rest(config.rest, blocks, needed, timeout)
    url = sources.url_of(bind)
    client = device.connect(url, blocks[0].unit, timeout)
    return sources.DeviceSource(f"listener {name} at {url}", client, blocks)


def _lines(
    source: Source, first: Sequence[Sequence[int]], every: float, times: int | None, as_json: bool
) -> None:
    """Prints every change. Prints errors and continues."""
    tracker = Tracker(source.blocks)
    tracker.update(time.monotonic(), first)
    for tick in pace.ticks(every, times):
        if tick == 0:
            continue
        try:
            values = source.read()
        except (ModbusError, Unreadable, OSError) as error:
            _say_error(str(error), as_json)
            continue
        for change in tracker.update(time.monotonic(), values):
            _say(change, as_json)


def _say(change: Change, as_json: bool) -> None:
    block = change.block
    if as_json:
        answer = {
            "time": showing.timestamp(),
            "ok": True,
            **({} if block.memory is None else {"memory": block.memory}),
            "area": block.area,
            "address": change.address,
            "was": change.was,
            "now": change.now,
        }
        click.echo(json.dumps(answer))
        return
    name = block.area if block.memory is None else f"{block.memory} {block.area}"
    step = "" if block.area in BIT_AREAS else f"  {change.now - change.was:+d}"
    click.echo(f"{showing.clock()}  {name} {change.address}: {change.was} -> {change.now}{step}")


def _say_error(text: str, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({"time": showing.timestamp(), "ok": False, "detail": text}))
    else:
        click.echo(f"{showing.clock()}  {text}")


def _fail(text: str, as_json: bool) -> NoReturn:
    if as_json:
        click.echo(json.dumps({"ok": False, "detail": text}))
    else:
        click.echo(f"holdfast: {text}", err=True)
    sys.exit(device.FAILED)
