"""`holdfast scan`: runs the scanner until a signal or a shutdown message."""

from __future__ import annotations

import asyncio
import logging
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args
from urllib.parse import urlsplit

import click

from holdfast import __version__
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.old_spellings import hint
from holdfast.cli.options.duration import Duration, time_option, timeout_option
from holdfast.cli.options.log_lines import log_format_option, log_level_option
from holdfast.cli.options.nats import DEFAULT_URL, nats_options, without_secrets
from holdfast.cli.options.option import (
    DecimalNumber,
    choice,
    flag,
    number_option,
    option,
    parsed_by,
    schema_option,
)
from holdfast.cli.options.tls import DEVICES, tls_options
from holdfast.cli.services.open_files import raise_open_file_limit
from holdfast.cli.signals import SIGNAL_INTERVAL_S, Signals
from holdfast.config.fingerprint import fingerprint
from holdfast.config.values.scanner_settings import (
    MAX_DEADBAND,
    MAX_PARTITIONS,
    MAX_SCAN_RATE,
    MAX_TIMEOUT,
    MIN_SCAN_RATE,
    MIN_TIMEOUT,
    PARTITIONS,
    PREFIX,
    SCAN_RATE,
    SERVER_PORT,
    TIMEOUT,
    Dialect,
    Publish,
    Writes,
    check_dialect,
    parse_fleet,
    parse_member,
    parse_pollable,
    parse_prefix,
)
from holdfast.events import log_lines
from holdfast.events.writer import announce
from holdfast.net import event_loop
from holdfast.net.allow_list import AllowedNetwork
from holdfast.net.nats.connection import Servers
from holdfast.net.nats_server import HOST, ServerUnusable, TemporaryServer
from holdfast.runtime.bounded_files import FileWork
from holdfast.runtime.interpreter import freeze_garbage_collector
from holdfast.runtime.standstill import WallClock
from holdfast.scanner.fleet.agreement import FleetRefused
from holdfast.scanner.jetstream.entry_subscriptions import BUCKET
from holdfast.scanner.messages.schema import json_schema
from holdfast.scanner.polling import device_tls as tls_check
from holdfast.scanner.polling.allowed_devices import PRIVATE
from holdfast.scanner.service import Scanner
from holdfast.scanner.settings import FleetSettings, Settings, places
from holdfast.scanner.subscriptions.request_rules import Defaults, ScannerLimits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from holdfast.net.allow_list import AllowEntry
    from holdfast.net.tls import Tls
    from holdfast.scanner.messages.types import SubscriptionRequest


class _Timeout(Duration):
    """A timeout of requests. Earlier versions took milliseconds for a number without a unit."""

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Parses a time, in seconds."""
        text = str(value)
        if text.isascii() and text.isdigit() and MIN_TIMEOUT <= int(text) <= MAX_TIMEOUT:
            if int(text) * 1000 <= MAX_TIMEOUT:
                self.fail(f"{text!r} is not clear: write {text}s or {text}ms.", param, ctx)
            hint(f"--timeout {text}", f"--timeout {text}ms")
            text += "ms"
        return super().convert(text, param, ctx)


FOLDER = click.Path(file_okay=False, path_type=Path)
TIMEOUTS = _Timeout(MIN_TIMEOUT / 1000, MAX_TIMEOUT / 1000)
INTERVALS = Duration(MIN_SCAN_RATE / 1000, MAX_SCAN_RATE / 1000)
_ALLOW = """Devices that subscribers may poll: a network, an address or a serial device; repeatable.
Without a network: private and loopback addresses."""
_WRITES = "Tags that may be written: all not declared read-only, those declared writable, or none."
_DEADBAND = "Default: minimum change of a number, with --publish change."
_KEEP = "Keep subscriptions in JetStream, and restore them after a restart."
_PARTITIONS = "Parts of the devices in a fleet: 20 times the number of scanners, or more."


@click.command(epilog="Example: holdfast scan --nats nats://10.0.0.5:4222 --allow 10.20.0.0/16")
@nats_options
@flag("--embedded", "Also start a NATS server, on the loopback interface.")
@option("--store", "FOLDER", "With --embedded: folder of JetStream.  [default: temporary]", FOLDER)
@option("--allow", "NETWORK", _ALLOW, multiple=True)
@option("--prefix", "SUBJECT", "First part of all subjects.", parsed_by(parse_prefix), PREFIX)
@choice("--dialect", "Programs of this kind are served.", get_args(Dialect), "tentacle")
@choice("--writes", _WRITES, get_args(Writes), "tags")
@timeout_option(f"{TIMEOUT}ms", "Default timeout of a Modbus request.", TIMEOUTS)
@choice("--publish", "Default: publish each value, or changes.", get_args(Publish), "scan")
@option("--deadband", "NUMBER", _DEADBAND, DecimalNumber(0, MAX_DEADBAND), 0.0)
@time_option("--every", "Default interval between scans.", f"{SCAN_RATE}ms", INTERVALS)
@flag("--strict", "Refuse requests with unknown keys or inexact values, instead of adjusting them.")
@flag("--publish-logs/--no-publish-logs", "Publish the log on service.logs.modbus.PREFIX.", True)
@flag("--keep-subscriptions/--no-keep-subscriptions", _KEEP, True)
@option("--fleet", "NAME", "Share devices with scanners of this fleet.", parsed_by(parse_fleet))
@option("--node", "NAME", "Name of this scanner in the fleet; unique.", parsed_by(parse_member))
@number_option("--partitions", _PARTITIONS, 1, MAX_PARTITIONS, PARTITIONS)
@tls_options("device", "device_tls", DEVICES, " for devices")
@log_level_option
@log_format_option
@schema_option("Print the JSON Schema of all messages and exit.", json_schema)
def scan(
    servers: Servers, device_tls: Tls, embedded: bool, store: Path | None, **options: Any
) -> None:
    """Run the NATS service, which polls Modbus devices for subscribers.

    Connects to a device when a client subscribes to its tags, and disconnects after the last
    subscriber leaves. Runs until Ctrl-C, SIGTERM or a message to PREFIX.shutdown. On SIGHUP, the
    files of the options are read anew. Exit codes: 0 stopped, 1 failed, 2 wrong usage, or refused
    by the other nodes of the fleet.
    """
    allow = _allowed(options["allow"])
    if options["deadband"] and options["publish"] != "change":
        raise click.UsageError("--deadband requires --publish change.")
    try:
        check_dialect(options["dialect"], options["prefix"])
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="'--prefix'") from None
    _check_fleet(options)
    if store is not None and not embedded:
        raise click.UsageError("--store requires --embedded.")
    log_lines.configure(options["log_level"], options["log_format"])
    raise_open_file_limit(ScannerLimits.devices)
    with ExitStack() as stack:
        check: Callable[[], None] | None = None
        try:
            tls_check.check(device_tls)
            if embedded:
                server = stack.enter_context(TemporaryServer(_embedded_port(servers), store))
                servers, check = Servers((server.url,)), server.check
            settings = _settings(options, servers, allow, device_tls)
            announce(_greeting(settings))
            event_loop.run(_serve(settings, check))
        except FleetRefused as refused:
            fail(f"fleet {options['fleet']}: {refused}", ExitCode.WRONG)
        except OSError as error:
            fail(error)


def _check_fleet(options: dict[str, Any]) -> None:
    """Raises a usage error for options that a fleet does not allow."""
    if options["fleet"] is None and options["node"] is None:
        return
    if options["fleet"] is None or options["node"] is None:
        raise click.UsageError("--fleet requires --node, and --node requires --fleet.")
    if options["dialect"] != "tentacle":
        raise click.UsageError(f"--dialect {options['dialect']} can't be used with --fleet.")
    if not options["keep_subscriptions"]:
        raise click.UsageError("--no-keep-subscriptions can't be used with --fleet.")


def _settings(
    options: dict[str, Any],
    servers: Servers,
    allow: tuple[AllowEntry, ...],
    trust: Tls,
) -> Settings:
    return Settings(
        servers,
        options["prefix"],
        allow,
        device_tls=trust,
        defaults=Defaults(
            round(options["timeout"] * 1000),
            options["publish"],
            options["deadband"],
            round(options["every"] * 1000),
        ),
        writes=options["writes"],
        strict=options["strict"],
        publish_logs=options["publish_logs"],
        keep_subscriptions=options["keep_subscriptions"],
        dialect=options["dialect"],
        fleet=None
        if options["fleet"] is None
        else FleetSettings(options["fleet"], options["node"], options["partitions"]),
    )


def _allowed(entries: tuple[str, ...]) -> tuple[AllowEntry, ...]:
    """The devices that subscribers may poll. Without a network, adds private addresses."""
    try:
        listed = tuple(map(parse_pollable, entries))
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="'--allow'") from None
    only_lines = listed and not any(isinstance(entry, AllowedNetwork) for entry in listed)
    return (*listed, *PRIVATE) if only_lines else listed


def _embedded_port(servers: Servers) -> int:
    """The port for the embedded server."""
    parts = urlsplit(servers.urls[0])
    plain = servers == Servers(servers.urls) and parts.username is None and parts.scheme == "nats"
    if len(servers.urls) > 1 or parts.hostname not in (HOST, "localhost") or not plain:
        allowed = f"--embedded only serves at {HOST}, without credentials"
        raise click.UsageError(f"{allowed}: --nats can only set its port, as in {DEFAULT_URL}.")
    return SERVER_PORT if parts.port is None else parts.port


async def _serve(settings: Settings, check: Callable[[], None] | None) -> None:
    signals = Signals(reload="with a terminal")
    log_lines.write(logging.INFO, "started", version=__version__)
    freeze_garbage_collector()
    former: Iterable[SubscriptionRequest] | None = ()
    while former is not None:
        former = await _scan(settings, check, signals, former)
    log_lines.tell_held_back(all_of_them=True)
    log_lines.write(logging.INFO, "stopped")


async def _scan(
    settings: Settings,
    check: Callable[[], None] | None,
    signals: Signals,
    former: Iterable[SubscriptionRequest],
) -> Iterable[SubscriptionRequest] | None:
    """Runs a scanner with the subscriptions of a former one.

    Returns its own if it ended because of files that have changed.
    """
    scanner, known, clock = Scanner(settings, former=former), _contents(settings), WallClock()
    running = asyncio.create_task(scanner.run())
    changed = False
    reading: FileWork[bool] | None = None
    while not running.done():
        await asyncio.wait([running], timeout=SIGNAL_INTERVAL_S)
        log_lines.tell_held_back()
        clock.look()
        if running.done():
            break
        try:
            if check is not None:
                check()
        except ServerUnusable:
            scanner.end()
            await running
            raise
        if signals.received:
            scanner.end()
        elif reading is not None and reading.is_over():
            changed, reading = _taken_over(reading), None
            if changed:
                scanner.end()
        elif reading is None and signals.take_reload():
            reading = FileWork(lambda: _has_changed(settings, known))
    await running
    # As a list: an iterator would keep the whole scanner.
    return list(scanner.stored_requests()) if changed and not signals.received else None


def _contents(settings: Settings) -> str:
    """A digest of the files of the options."""
    servers = settings.servers
    named = [servers.password_file, servers.token_file, servers.credentials]
    for tls in (servers.tls, settings.device_tls):
        named += [Path(file) for _, file in tls.files()]
    return fingerprint([file for file in named if file is not None])


def _has_changed(settings: Settings, known: str) -> bool:
    """Whether the files have changed. Raises `OSError` if they can't be used."""
    settings.servers.options()
    tls_check.check(settings.device_tls)
    return _contents(settings) != known


def _taken_over(reading: FileWork[bool]) -> bool:
    """Whether the files have changed and can be used. Logs what it finds."""
    try:
        changed = reading.result()
    except OSError as error:
        log_lines.write(logging.ERROR, "reload_refused", problem=str(error))
        return False
    log_lines.write(logging.INFO, "reloaded", changed="files" if changed else "nothing")
    return changed


def _greeting(settings: Settings) -> str:
    prefix, fleet = settings.prefix, settings.fleet
    servers = ", ".join(str(without_secrets(url)) for url in settings.servers.urls)
    is_next = settings.dialect == "tentacle-next"
    data = f"{prefix}.data.DEVICE.TAG" if is_next else f"{prefix}.data.DEVICE"
    lines = [
        f"Scanning for subscribers at {servers}.",
        "",
        f"  requests   {prefix}.subscribe, {prefix}.unsubscribe, {prefix}.browse, "
        f"{prefix}.variables",
        f"  commands   {prefix}.command.TAG, {prefix}.command.DEVICE.TAG",
        f"  published  {data}, {prefix}.status.DEVICE",
        *([f"  entries    bucket {BUCKET}{prefix}"] if is_next else []),
        *([] if fleet is None else [f"  fleet      {fleet.name}, as node {fleet.node}"]),
        f"  devices    {places(settings.allow)}",
        *_write_access(settings),
        "",
        "Ctrl-C stops it.",
    ]
    return "\n".join(lines)


def _write_access(settings: Settings) -> Iterator[str]:
    """The write access of clients. It is printed because the default lets every client write."""
    found = settings.write_access
    yield f"  writes     {found['tags']}"
    for key in ("by", "narrowed_by", "set_by"):
        if key in found:
            yield f"             {key.replace('_', ' ')} {found[key]}"
