"""`holdfast watch`: a live view of a device, or of the memories of an appliance."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli import device_errors, standard_output, terminal_text
from holdfast.cli.devices import coverage
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.live import schedule, sources
from holdfast.cli.live.changes import Tracker
from holdfast.cli.live.sources import Unreadable, Unwatchable, WatchedRange
from holdfast.cli.options import device, item
from holdfast.cli.options.duration import every_option
from holdfast.cli.options.item import words_argument
from holdfast.cli.options.option import json_option, number_option, option, require_known
from holdfast.cli.options.url import checked_url, is_url
from holdfast.cli.progress import bar
from holdfast.cli.signals import stops_as_ctrl_c
from holdfast.cli.tags import options as tag_options
from holdfast.cli.tags.options import TagFiles
from holdfast.cli.terminal_text import print_json
from holdfast.client.requests import REFUSALS
from holdfast.discovery import address_search
from holdfast.discovery.address_search import Probe
from holdfast.errors import ModbusError, ModbusException
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.live.changes import Change
    from holdfast.cli.live.sources import Source
    from holdfast.cli.options.plc_addresses import Place
    from holdfast.cli.tags.options import Selection, TagFiles
    from holdfast.client import SyncClient
    from holdfast.discovery.address_search import AreaMap, Survey

TOKEN = "HOLDFAST_TOKEN"


@click.command(epilog="Example: holdfast watch plant.yaml")
@click.argument("target", metavar="URL|FILE")
@words_argument(item.ITEMS)
@option("--memory", "NAME", "With FILE: only this memory.")
@every_option("1", "Interval between readings.")
@number_option("--times", "Stop after N readings.")
@tag_options.tag_file_options
@tag_options.selection_options
@device.device_options
@json_option
def watch(
    target: str,
    words: tuple[str, ...],
    memory: str | None,
    every: float,
    times: int | None,
    files: TagFiles,
    selection: Selection,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Watch a device, or the memories of a running appliance; nothing is written.

    With URL, reads COUNT addresses (default: 1) from ITEM of the device: hr 0, 40001, 4x0001 or
    %MW0. Without ITEM, reads all addresses that `holdfast describe map` finds.

    AREA:ADDRESS are several values, each with a type and order of its own, as in hr:0:float32
    hr:10:uint32:CDAB coil:3. With --tags, reads the tags of a list.

    With FILE, the configuration of an appliance on this machine, reads its memories over its REST
    interface (with the token in HOLDFAST_TOKEN), or else over its first listener of type
    modbus-tcp.

    On a terminal, shows all values, with changes highlighted, and rates of change. q quits, n and p
    turn pages. Without a terminal, on a dumb one (TERM=dumb), or with --json, prints a line for
    every change; with --csv, a line for every reading.

    Exit codes: 0 ended by q, Ctrl-C, SIGTERM or SIGHUP, 1 the first reading failed, 2 wrong usage.
    """
    click.get_current_context().with_resource(stops_as_ctrl_c())
    if is_url(target) or files.config is not None:
        untyped = (None, "ABCD", None)
        of = tag_options.device_of(files, target, words, selection.only, untyped, unit, timeout)
        if of is not None:
            from holdfast.cli.tags import source as tag_source
            from holdfast.cli.tags import watch as tagged_watch

            of = replace(of, url=checked_url(of.url))
            if memory is not None:
                raise click.UsageError("--memory requires FILE.")
            form = tag_options.form_of(as_json, selection.csv)
            with tag_source.opened(of, selection) as tagged:
                tagged_watch.watch_tags(tagged, form, every, times)
            return
    elif files.given or item.are_several(words):
        raise click.UsageError("AREA:ADDRESS and --tags require URL, not FILE.")
    selection.refuse()
    url = is_url(target)
    if url and memory is not None:
        raise click.UsageError("--memory requires FILE.")
    chosen = None
    if words:
        place, count = item.single(words)
        chosen = place, count or 1
    if url:
        source = _device(checked_url(target), chosen, unit, timeout)
    else:
        source = _appliance(Path(target), memory, chosen, timeout)
    source.blocks, missing = sources.cut(source.blocks)
    note = f"{terminal_text.counted(missing, 'more address')} are not watched" if missing else None
    try:
        try:
            first = source.read()
        except (ModbusError, Unreadable, OSError) as error:
            device_errors.fail(error, source.url, where=source.where)
        if not as_json and standard_output.is_screen():
            from holdfast.cli.live.registers_view import View

            view = View(source, first, every, note)
            view.run(times)
            device_errors.hint(view.error, source.url)
        else:
            click.echo(f"watching {source.where}{f'; {note}' if note else ''}", err=True)
            _lines(source, first, every, times, as_json)
    except KeyboardInterrupt:
        pass
    finally:
        source.close()


def _device(url: str, chosen: tuple[Place, int] | None, unit: int, timeout: float) -> Source:
    """The blocks of a device: the requested block, or all that exist."""
    client = device.connect(url, unit, timeout)
    where = f"{url}, unit {unit}"
    if chosen is not None:
        place, count = chosen
        block = WatchedRange(None, unit, place.area, place.address, count)
        return sources.DeviceSource(where, url, client, [block])
    survey = address_search.Survey(dense=False)
    click.echo(f"{where}: searching for addresses", err=True)
    blocks: list[WatchedRange] = []
    try:
        with bar("Mapping", survey.total, lambda: f"{survey.requests} requests") as advance:
            address_search.run_sync(
                survey, client.read, advance and (lambda survey: advance(survey.at))
            )
        for found in survey.areas:
            blocks += [
                WatchedRange(None, unit, found.area, part.address, part.count)
                for extent in found.ranges
                for part in _parts(client, survey, found, extent)
            ]
    except ModbusError as error:
        client.close()
        device_errors.fail(error, url)
    if not blocks:
        client.close()
        device_errors.fail("no address was found", url)
    return sources.DeviceSource(where, url, client, blocks)


def _parts(client: SyncClient, survey: Survey, found: AreaMap, extent: range) -> list[Probe]:
    """A range, in parts that the device returns, if it takes less at once than the standard.

    What it refuses meanwhile is left out, and named. Other errors may pass: the first reading
    decides.
    """
    blocks = [
        Probe(found.area, first, min(found.limit, extent.stop - first))
        for first in range(extent.start, extent.stop, found.limit)
    ]
    parts = []
    for block in blocks:
        for part, content in address_search.read_in_parts(survey, client.read, block, found.width):
            if isinstance(content, ModbusException) and content.code in REFUSALS:
                at = coverage.shown([range(part.address, part.address + part.count)])
                click.echo(f"{part.area} {at} is not watched: {content}", err=True)
            else:
                parts.append(part)
    # In a short range, the search does not find that a device takes less.
    if parts == blocks and not found.takes_less:
        return [Probe(found.area, extent.start, len(extent))]
    return parts


def _appliance(
    file: Path, memory: str | None, chosen: tuple[Place, int] | None, timeout: float
) -> Source:
    """The memories of an appliance, read over REST or Modbus TCP."""
    # The configuration takes long to import: who watches a device does not wait for it.
    from holdfast.cli.configuration import load_or_exit
    from holdfast.cli.live import appliance_sources

    config = load_or_exit(file)
    if memory is not None:
        require_known(memory, config.memories, f"{file} has no memory", "memories")
    try:
        blocks, opened = appliance_sources.readable(config, os.environ.get(TOKEN))
    except Unwatchable as error:
        fail(f"{file}: {error}", ExitCode.WRONG, reason="configuration", prefix="")
    if memory is not None:
        blocks = [block for block in blocks if block.memory == memory]
    if chosen is not None:
        place, count = chosen
        blocks = sources.within(blocks, place.area, place.address, count)
    if not blocks:
        why = "none of the requested addresses can be read"
        fail(f"{file}: {why}", ExitCode.WRONG, reason="configuration", prefix="")
    return opened(blocks, timeout)


def _lines(
    source: Source, first: Sequence[Sequence[int]], every: float, times: int | None, as_json: bool
) -> None:
    """Prints every change. Prints errors and continues."""
    tracker = Tracker(source.blocks)
    tracker.update(time.monotonic(), first)
    for tick in schedule.ticks(every, times):
        if tick == 0:
            continue
        try:
            values = source.read()
        except (ModbusError, Unreadable, OSError) as error:
            sources.print_error(error, source.url)
            continue
        for change in tracker.update(time.monotonic(), values):
            _print_change(change, source.url, as_json)


def _print_change(change: Change, url: str, as_json: bool) -> None:
    block = change.block
    if as_json:
        answer = {
            "ok": True,
            "target": url,
            **({"unit": block.unit} if block.memory is None else {"memory": block.memory}),
            "time": terminal_text.timestamp(),
            "area": block.area,
            "address": change.address,
            "was": change.was,
            "now": change.now,
        }
        print_json(answer)
        return
    name = block.area if block.memory is None else f"{block.memory} {block.area}"
    step = "" if block.area in BIT_AREAS else f"  {change.now - change.was:+d}"
    click.echo(
        f"{terminal_text.clock()}  {name} {change.address}: {change.was} -> {change.now}{step}"
    )
