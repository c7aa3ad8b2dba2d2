"""`holdfast log replay`: the memories of a log as they were, at any moment that it still covers."""

from __future__ import annotations

import json
import time
from contextlib import ExitStack, contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from holdfast import _core
from holdfast.appliance.client_credentials import nats_servers
from holdfast.appliance.parts import log_servers
from holdfast.appliance.parts.memories import empty
from holdfast.appliance.parts.shared_logs import credentials, servers
from holdfast.cli.appliance import memory_file
from holdfast.cli.appliance.memory_file import KeptArea
from holdfast.cli.configuration import load_or_exit
from holdfast.cli.exit_codes import fail
from holdfast.cli.options.bind_and_source import bind_option, unbindable
from holdfast.cli.options.logs import chosen_log, log_option
from holdfast.cli.options.option import (
    config_argument,
    file_option,
    flag,
    json_option,
    option,
)
from holdfast.cli.signals import SIGNAL_INTERVAL_S, Signals
from holdfast.cli.terminal_text import print_json
from holdfast.events import log_lines
from holdfast.net.addresses import joined
from holdfast.net.nats.connection import FIRST_ANSWER_TIMEOUT_S
from holdfast.net.nats_server import ServerUnusable
from holdfast.runtime.text import listing
from holdfast.server import Server

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.config.values.ip_addresses import Bind
    from holdfast.types import LogRecord

MAX_SEQUENCE = 2**64 - 1
MAX_TIME_NS = 2**63 - 1
"""Since 1970: in the year 2262."""


@click.command(epilog="Example: holdfast log replay plant.yaml --to 2026-11-20T14:05:00Z --values")
@config_argument
@log_option
@option(
    "--to",
    "SEQUENCE|TIME",
    "The last step: its sequence in the stream, or a time as in 2026-11-20T14:05:00Z. "
    "A sequence that the log does not have is an error; a time before its first message, or after "
    "its last one, is noted. "
    "Default: the last one there is.",
)
@flag("--follow", "Print each step, also those to come.")
@flag("--values", "Print all values that are not 0.")
@file_option(
    "--output", "Write the values of a memory to a .csv, .yaml or .yml file, as `initial`."
)
@option("--memory", "NAME", "The memory of --output. Required if there are several.")
@bind_option(None, "Serve the memories here, read-only, as units 1, 2, …, to this machine.")
@json_option
def replay(
    file: Path,
    name: str | None,
    to: str | None,
    follow: bool,
    values: bool,
    output: Path | None,
    memory: str | None,
    bind: Bind | None,
    as_json: bool,
) -> None:
    """Rebuild the memories of a log in FILE as they were, without changing the log.

    Prints the digest of the contents, which all nodes have at the same sequence. Exit codes: 0
    done, 1 the log can't be read or the command was interrupted, 2 wrong usage.
    """
    if bind is not None and not bind.address.is_loopback:
        raise click.UsageError(f"--bind {bind}: a replay is only served to this machine.")
    others = {"--to": to is not None, "--output": output is not None, "--values": values}
    for other, is_given in others.items():
        if follow and is_given:
            raise click.UsageError(f"--follow and {other} can't be used together.")
    if memory is not None and output is None:
        raise click.UsageError("--memory is for --output.")
    config = load_or_exit(file)
    log = chosen_log(config, name)
    settings = config.logs[log]
    memories = [
        (each, empty(config, each))
        for each, memory in config.memories.items()
        if memory.replicate is not None and memory.replicate.log == log
    ]
    if not memories:
        raise click.UsageError(f"no memory is replicated through the log {log}.")
    chosen = None
    if output is not None:
        memory_file.kind_of(output)
        of_name = dict(memories)
        chosen = of_name[memory_file.chosen(of_name, memory, "the log")]
    signals = Signals()
    with ExitStack() as running:
        try:
            sequence, time_ns = _end(to)
            running.enter_context(log_servers.running(log, settings))
            opened = partial(
                _core.LogReader,
                log,
                servers(settings),
                memories,
                sequence=sequence,
                time_ns=time_ns,
                follow=follow,
                connect_timeout=FIRST_ANSWER_TIMEOUT_S / len(settings.servers),
                **credentials(settings),
            )
            replaying = opened()
            last = replaying.sequence
            to_serve = bind if follow else None
            while not signals.received and not replaying.ended:
                # Not the values of a snapshot that the log has left behind.
                if to_serve is not None and replaying.sequence >= replaying.last_sequence:
                    running.enter_context(_served(memories, to_serve, as_json=as_json))
                    to_serve = None
                try:
                    record = replaying.next(SIGNAL_INTERVAL_S)
                except _core.LogError as error:
                    if not follow or not _passes(error):
                        raise
                    reason = str(error).partition(": ")[2]
                    click.echo(f"holdfast: logs.{log}: no contact, retried: {reason}", err=True)
                    replaying = _reopened(opened, signals) or replaying
                    last = _noted(replaying, last)
                    continue
                # After an outage, what was shown before it comes again.
                if record is not None and follow and record["sequence"] > last:
                    last = record["sequence"]
                    # Nodes without writes prove their contact with messages without steps.
                    if record["steps"]:
                        click.echo(_line(file, record, as_json=as_json))
            if not follow:
                if not replaying.ended:
                    fail("interrupted", reason="interrupted")
                _check_end(replaying, sequence, time_ns)
                if chosen is not None and output is not None:
                    areas = {
                        area: KeptArea(
                            addresses.start, chosen.read(area, addresses.start, len(addresses))
                        )
                        for area, addresses in _areas_and_files(chosen)
                    }
                    text = memory_file.written(areas, memory_file.kind_of(output), zeros=False)
                    memory_file.write(output, text)
                _tell(file, replaying, memories, values=values, as_json=as_json)
        except (_core.LogError, ServerUnusable, ValueError) as error:
            shown = nats_servers(settings).shown
            where = f" (servers: {shown})" if isinstance(error, _core.LogError) else ""
            fail(f"logs.{log}: {error}{where}", reason="connection" if where else "failed")
    if bind is not None and not follow and not signals.received:
        with _served(memories, bind, as_json=as_json):
            while not signals.received:
                time.sleep(SIGNAL_INTERVAL_S)


def _passes(error: _core.LogError) -> bool:
    """Whether servers can't be reached, as opposed to a log that can't be followed."""
    return bool(error.kind == "no_connection")


def _reopened(opened: Callable[[], _core.LogReader], signals: Signals) -> _core.LogReader | None:
    """The log from its newest snapshot on, as soon as its servers answer; `None` at a signal."""
    while not signals.received:
        try:
            return opened()
        except _core.LogError as error:
            if not _passes(error):
                raise
            time.sleep(SIGNAL_INTERVAL_S)
    return None


def _noted(replaying: _core.LogReader, last: int) -> int:
    """Notes steps that only a newer snapshot has. Returns the last that is not to be shown."""
    if replaying.sequence > last:
        missing = f"steps {last + 1} to {replaying.sequence} are not shown"
        click.echo(f"holdfast: {missing}: the log has a newer snapshot", err=True)
    return max(replaying.sequence, last)


def _end(to: str | None) -> tuple[int | None, int | None]:
    """The sequence or the time, in nanoseconds since 1970."""
    if to is None:
        return None, None
    try:
        if to.isascii() and to.isdigit():
            return _within(int(to), MAX_SEQUENCE), None
        return None, _within(int(datetime.fromisoformat(to).timestamp() * 1e9), MAX_TIME_NS)
    except (ValueError, OverflowError):
        message = f"found {to!r}, allowed: a sequence, or a time as in 2026-11-20T14:05:00Z"
        raise click.BadParameter(message, param_hint="'--to'") from None


def _within(number: int, most: int) -> int:
    if 0 <= number <= most:
        return number
    raise ValueError


def _check_end(replaying: _core.LogReader, sequence: int | None, time_ns: int | None) -> None:
    """Raises `ValueError` for a sequence that the log does not have, and notes a time beyond it."""
    when = log_lines.timestamp(replaying.time_ns / 1e9)
    end = f"the log ends at sequence {replaying.sequence}, {when}"
    if replaying.sequence == 0:
        end = "the log has no message yet"
    if sequence is not None and sequence > replaying.sequence:
        raise ValueError(f"--to is {sequence}, but {end}")
    if time_ns is None:
        return
    is_last = replaying.sequence >= replaying.last_sequence
    if replaying.sequence == 0:
        began = "these are the values that the log began with"
        click.echo(f"holdfast: --to is before the first message: {began}", err=True)
    elif is_last and time_ns > replaying.time_ns:
        click.echo(f"holdfast: --to is after the last message: {end}", err=True)


def _tell(
    file: Path,
    replaying: _core.LogReader,
    memories: list[tuple[str, _core.Memory]],
    *,
    values: bool,
    as_json: bool,
) -> None:
    found = {"sequence": replaying.sequence, "digest": replaying.digest()}
    kept = [
        (name, area, address, value)
        for name, memory in (memories if values else ())
        for area, addresses in _areas_and_files(memory)
        for address, value in zip(
            addresses, memory.read(area, addresses.start, len(addresses)), strict=True
        )
        if value
    ]
    if as_json:
        head = {"ok": True, "target": str(file), **found}
        keys = ("memory", "area", "address", "value")
        rows = [dict(zip(keys, row, strict=True)) for row in kept]
        print_json(head | ({"values": rows} if values else {}))
        return
    click.echo(f"sequence {found['sequence']}, digest {found['digest']}")
    for name, area, address, value in kept:
        click.echo(f"{name} {area} {address}: {value}")


def _areas_and_files(memory: _core.Memory) -> Iterator[tuple[Any, range]]:
    yield from memory.areas.items()
    for number, records in memory.files.items():
        yield f"{memory_file.FILE}{number}", range(records)


def _line(file: Path, record: LogRecord, *, as_json: bool) -> str:
    when = log_lines.timestamp(record["time_ns"] / 1e9)
    if as_json:
        return json.dumps({"ok": True, "target": str(file), "time": when, "answer": record})
    head = f"{record['sequence']} {when} {record['node'] or '-'}"
    steps = [_step(step) for step in record["steps"]] if record["fresh"] else ["a repeated message"]
    return "\n".join(f"{head} {step}" for step in steps)


def _step(step: Any) -> str:
    writes = [
        f"{memory} {area} {address}: {listing(values)}"
        for memory, area, address, values in step.get("writes", ())
    ]
    if "place" in step:
        memory, area, address = step["place"]
        and_mask, or_mask = step["masks"]
        writes.append(f"{memory} {area} {address}: AND {and_mask:#06x} OR {or_mask:#06x}")
    refused = step.get("refused")
    return "; ".join(writes) + (f" (refused: {refused})" if refused else "")


@contextmanager
def _served(
    memories: list[tuple[str, _core.Memory]], bind: Bind, *, as_json: bool
) -> Iterator[None]:
    units = {unit: memory for unit, (_, memory) in enumerate(memories, start=1)}
    try:
        server = Server(units, bind=str(bind), access="read-only")
    except OSError as error:
        fail(unbindable(bind, error))
    with server:
        address = joined(*server.address)
        for unit, (name, _) in enumerate(memories, start=1):
            click.echo(f"{name}: tcp://{address}, unit {unit}, read-only", err=as_json)
        click.echo("Ctrl-C stops it.", err=as_json)
        yield
