"""`holdfast replay`: the memories of a log as they were at any moment that the log still covers."""

from __future__ import annotations

import json
import sys
import time
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from holdfast import _core, logs
from holdfast.appliance import assembly, embedded
from holdfast.appliance.shared_logs import credentials, servers
from holdfast.cli.configuration import load_or_exit
from holdfast.cli.logs_of import chosen_log
from holdfast.cli.signals import Signals
from holdfast.nats_server import ServerUnusable
from holdfast.runtime.text import listing
from holdfast.scanner.nats import ANSWERING
from holdfast.server import Server

if TYPE_CHECKING:
    from holdfast.types import LogRecord

NOTICE = 0.1
"""Seconds within which a signal is noticed."""

MAX_SEQUENCE = 2**64 - 1
MAX_TIME = 2**63 - 1
"""In nanoseconds since 1970: in the year 2262."""


@click.command(epilog="Example: holdfast replay plant.yaml --to 2026-11-20T14:05:00Z --values")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--log", "name", metavar="NAME", help="Required if there are several logs.")
@click.option(
    "--to",
    metavar="SEQUENCE|TIME",
    help="The last step: its sequence in the stream, or a time as in 2026-11-20T14:05:00Z. "
    "A sequence that the log does not have is an error; a time after its last message is noted. "
    "Default: the last one there is.",
)
@click.option("--follow", is_flag=True, help="Print each step, also those to come.")
@click.option("--values", is_flag=True, help="Print all values that are not 0.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    metavar="N",
    help="Serve the memories on this port of 127.0.0.1, read-only, as units 1, 2, ….",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines for programs.")
def replay(
    file: Path,
    name: str | None,
    to: str | None,
    follow: bool,
    values: bool,
    port: int | None,
    as_json: bool,
) -> None:
    """Rebuild the memories of a log in FILE as they were, without changing the log.

    Prints the digest of the contents, which all nodes have at the same sequence. Exit codes: 0
    done, 1 the log can't be read, 2 wrong usage.
    """
    if follow and to is not None:
        raise click.UsageError("--follow and --to can't be used together.")
    config = load_or_exit(file)
    log = chosen_log(config, name)
    settings = config.logs[log]
    memories = [
        (each, assembly.memory(config.memories[each]))
        for each, memory in config.memories.items()
        if memory.replicate is not None and memory.replicate.log == log
    ]
    if not memories:
        raise click.UsageError(f"no memory is replicated through the log {log}.")
    signals = Signals()
    with ExitStack() as running:
        try:
            sequence, time_ns = _end(to)
            running.enter_context(embedded.running(log, settings))
            replaying = _core.LogFollower(
                log,
                servers(settings),
                memories,
                sequence=sequence,
                time_ns=time_ns,
                follow=follow,
                connect_timeout=ANSWERING / len(settings.servers),
                **credentials(settings),
            )
            while not signals.received and not replaying.ended:
                record = replaying.next(NOTICE)
                if record is not None and follow:
                    click.echo(_line(record, as_json=as_json))
            if not follow:
                if replaying.ended:
                    _check_end(replaying, sequence, time_ns)
                _tell(replaying, memories, values=values, as_json=as_json)
        except (_core.LogError, ServerUnusable, ValueError) as error:
            shown = assembly.nats_servers(settings).shown
            where = f" (servers: {shown})" if isinstance(error, _core.LogError) else ""
            _fail(f"logs.{log}: {error}{where}")
    if port is not None and not signals.received:
        _serve(memories, port, signals)


def _end(to: str | None) -> tuple[int | None, int | None]:
    """The sequence or the time, in nanoseconds since 1970."""
    if to is None:
        return None, None
    try:
        if to.isascii() and to.isdigit():
            return _within(int(to), MAX_SEQUENCE), None
        return None, _within(int(datetime.fromisoformat(to).timestamp() * 1e9), MAX_TIME)
    except (ValueError, OverflowError):
        message = f"found {to!r}, allowed: a sequence, or a time as in 2026-11-20T14:05:00Z"
        raise click.BadParameter(message, param_hint="'--to'") from None


def _within(number: int, most: int) -> int:
    if 0 <= number <= most:
        return number
    raise ValueError


def _check_end(replaying: _core.LogFollower, sequence: int | None, time_ns: int | None) -> None:
    """Raises `ValueError` for a sequence that the log does not have, and notes a time after it."""
    when = logs.timestamp(replaying.time_ns / 1e9)
    end = f"the log ends at sequence {replaying.sequence}, {when}"
    if sequence is not None and sequence > replaying.sequence:
        raise ValueError(f"--to is {sequence}, but {end}")
    is_last = replaying.sequence >= replaying.last_sequence
    if time_ns is not None and is_last and time_ns > replaying.time_ns:
        click.echo(f"holdfast: --to is after the last message: {end}", err=True)


def _tell(
    replaying: _core.LogFollower,
    memories: list[tuple[str, _core.Memory]],
    *,
    values: bool,
    as_json: bool,
) -> None:
    found = {"sequence": replaying.sequence, "digest": replaying.digest()}
    kept = [
        (name, area, address, value)
        for name, memory in (memories if values else ())
        for area, addresses in memory.areas.items()
        for address, value in zip(
            addresses, memory.read(area, addresses.start, len(addresses)), strict=True
        )
        if value
    ]
    if as_json:
        click.echo(json.dumps(found | ({"values": kept} if values else {})))
        return
    click.echo(f"sequence {found['sequence']}, digest {found['digest']}")
    for name, area, address, value in kept:
        click.echo(f"{name} {area} {address}: {value}")


def _line(record: LogRecord, *, as_json: bool) -> str:
    if as_json:
        return json.dumps(record)
    when = logs.timestamp(record["time_ns"] / 1e9)
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
    return "; ".join(writes)


def _serve(memories: list[tuple[str, _core.Memory]], port: int, signals: Signals) -> None:
    units = {unit: memory for unit, (_, memory) in enumerate(memories, start=1)}
    try:
        server = Server(units, bind=f"127.0.0.1:{port}", access="read-only")
    except OSError as error:
        _fail(f"port {port}: {error.strerror or error}")
    with server:
        host, bound = server.address
        for unit, (name, _) in enumerate(memories, start=1):
            click.echo(f"{name}: tcp://{host}:{bound}, unit {unit}, read-only")
        click.echo("Ctrl-C stops it.")
        while not signals.received:
            time.sleep(NOTICE)


def _fail(message: str) -> NoReturn:
    click.echo(f"holdfast: {message}", err=True)
    sys.exit(1)
