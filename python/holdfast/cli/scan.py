"""`holdfast scan`: runs the scanner until a signal or a shutdown message."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args
from urllib.parse import urlsplit

import click

from holdfast import __version__, logs
from holdfast.bounded_files import FileWork
from holdfast.cli.log_options import FORMATS
from holdfast.cli.open_files import allow_open_files
from holdfast.cli.run import JOIN_TIMEOUT
from holdfast.cli.signals import Signals
from holdfast.cli.tls_options import DEVICES, tls_of, tls_options
from holdfast.config.fingerprint import fingerprint
from holdfast.config.scanning import (
    MAX_DEADBAND,
    MAX_PARTITIONS,
    MAX_PING_INTERVAL,
    MAX_PINGS,
    MAX_SCAN_RATE,
    MAX_TIMEOUT,
    MIN_PING_INTERVAL,
    MIN_SCAN_RATE,
    MIN_TIMEOUT,
    PARTITIONS,
    PING_INTERVAL,
    PINGS_OUTSTANDING,
    PREFIX,
    SCAN_RATE,
    SERVER_PORT,
    TIMEOUT,
    Dialect,
    Publish,
    Writes,
    check_dialect,
    parse_member,
    parse_pollable,
    parse_prefix,
    parse_server,
)
from holdfast.nats_server import HOST, ServerUnusable, TemporaryServer
from holdfast.net import event_loop
from holdfast.net.allow_list import AllowedNetwork
from holdfast.runtime.standstill import WallClock
from holdfast.scanner import (
    Defaults,
    FleetRefused,
    FleetSettings,
    Ping,
    Scanner,
    ScannerLimits,
    Servers,
    Settings,
)
from holdfast.scanner.jetstream.entry_subscriptions import BUCKET
from holdfast.scanner.messages.schema import json_schema
from holdfast.scanner.polling import device_tls
from holdfast.scanner.polling.allowed_devices import PRIVATE
from holdfast.scanner.write_access import places

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.config.remote import Remote
    from holdfast.net.allow_list import AllowEntry
    from holdfast.net.tls import Tls

DEFAULT_URL = f"nats://127.0.0.1:{SERVER_PORT}"
FAILED = 1
REFUSED = 2

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


def server_urls(text: str) -> list[str]:
    """Parses a comma-separated list of server URLs. Default scheme: nats://."""
    urls = []
    for part in filter(None, map(str.strip, text.split(","))):
        url = part if "://" in part else f"nats://{part}"
        try:
            _server(url)
        except ValueError as error:
            raise click.BadParameter(f"{error}, as in {DEFAULT_URL}.") from None
        urls.append(url)
    return urls


def _server(url: str) -> Remote:
    """Parses a server URL. A user and password before the host, and port 0, are allowed."""
    scheme, mark, rest = url.removesuffix("/").partition("://")
    return parse_server(f"{scheme}{mark}{rest.rpartition('@')[2]}", least_port=0)


def _prefix(text: str) -> str:
    try:
        return parse_prefix(text)
    except ValueError as error:
        raise click.BadParameter(f"{error}.") from None


def member(text: str) -> str:
    """Parses the name of a fleet or of a node."""
    try:
        return parse_member(text)
    except ValueError as error:
        raise click.BadParameter(f"{error}.") from None


def _print_schema(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted:
        click.echo(json.dumps(json_schema(), indent=2))
        ctx.exit()


@click.command(epilog="Example: holdfast scan --nats nats://10.0.0.5:4222 --allow 10.20.0.0/16")
@click.option(
    "--nats",
    "nats",
    multiple=True,
    type=server_urls,
    metavar="URL",
    help=f"NATS server; repeatable. [env: NATS_SERVERS, comma-separated; default: {DEFAULT_URL}]",
)
@click.option(
    "--embedded", is_flag=True, help="Also start a NATS server, on the loopback interface."
)
@click.option(
    "--store",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="FOLDER",
    help="With --embedded: folder for JetStream data.  [default: a temporary folder]",
)
@click.option(
    "--allow",
    multiple=True,
    metavar="NETWORK",
    help="Devices that subscribers may poll: a network, an address or a serial device; "
    "repeatable. Without a network: private and loopback addresses.",
)
@click.option(
    "--prefix",
    type=_prefix,
    default=PREFIX,
    show_default=True,
    metavar="SUBJECT",
    help="First part of all subjects.",
)
@click.option(
    "--dialect",
    type=click.Choice(get_args(Dialect)),
    default="tentacle",
    show_default=True,
    help="Programs to serve: those of tentacle-modbus, or of tentacle-next.",
)
@click.option(
    "--writes",
    type=click.Choice(get_args(Writes)),
    default="tags",
    show_default=True,
    help="Tags that may be written: all not declared read-only, those declared writable, or none.",
)
@click.option(
    "--timeout",
    type=click.IntRange(MIN_TIMEOUT, MAX_TIMEOUT),
    default=TIMEOUT,
    show_default=True,
    metavar="MS",
    help="Default timeout of a Modbus request.",
)
@click.option(
    "--publish",
    type=click.Choice(get_args(Publish)),
    default="scan",
    show_default=True,
    help="Default for subscriptions: publish every value, or changes.",
)
@click.option(
    "--deadband",
    type=click.FloatRange(0, MAX_DEADBAND),
    default=0.0,
    show_default=True,
    metavar="NUMBER",
    help="Default for subscriptions: minimum change of a number, with --publish change.",
)
@click.option(
    "--scan-rate",
    type=click.IntRange(MIN_SCAN_RATE, MAX_SCAN_RATE),
    default=SCAN_RATE,
    show_default=True,
    metavar="MS",
    help="Default scan interval.",
)
@click.option(
    "--strict",
    is_flag=True,
    help="Refuse requests with unknown keys or inexact values, instead of adjusting them.",
)
@click.option(
    "--ping-interval",
    type=click.FloatRange(MIN_PING_INTERVAL, MAX_PING_INTERVAL),
    default=PING_INTERVAL,
    show_default=True,
    metavar="SECONDS",
    help="Interval of pings to the NATS server.",
)
@click.option(
    "--ping-outstanding",
    type=click.IntRange(1, MAX_PINGS),
    default=PINGS_OUTSTANDING,
    show_default=True,
    metavar="N",
    help="Pings without an answer before a reconnect.",
)
@click.option(
    "--publish-logs/--no-publish-logs",
    default=True,
    show_default=True,
    help="Publish the log on service.logs.modbus.PREFIX.",
)
@click.option(
    "--keep-subscriptions/--no-keep-subscriptions",
    default=True,
    show_default=True,
    help="Keep subscriptions in JetStream, and restore them after a restart.",
)
@click.option(
    "--fleet",
    type=member,
    metavar="NAME",
    help="Share the devices with the scanners of this fleet.",
)
@click.option(
    "--node", type=member, metavar="NAME", help="Name of this scanner in the fleet; unique."
)
@click.option(
    "--partitions",
    type=click.IntRange(1, MAX_PARTITIONS),
    default=PARTITIONS,
    show_default=True,
    metavar="N",
    help="Parts of the devices in a fleet: 20 times the number of scanners, or more.",
)
@click.option("--user", metavar="NAME", help="User name for the NATS server.")
@click.option("--password-file", type=FILE, metavar="FILE", help="File with the user's password.")
@click.option(
    "--token-file", type=FILE, metavar="FILE", help="File with a token for the NATS server."
)
@click.option("--creds", type=FILE, metavar="FILE", help="File with a user's JWT and seed.")
@tls_options("tls", "Trusted authorities for the NATS server.")
@tls_options("device", DEVICES, " for devices")
@click.option(
    "--max-devices",
    type=click.IntRange(1),
    default=ScannerLimits.devices,
    show_default=True,
    metavar="N",
)
@click.option(
    "--max-tags",
    type=click.IntRange(1),
    default=ScannerLimits.tags,
    show_default=True,
    metavar="N",
    help="Tags of all devices.",
)
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="info",
    show_default=True,
)
@click.option("--log-format", type=FORMATS, default="text", show_default=True)
@click.option(
    "--schema",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_schema,
    help="Print the JSON Schema of all messages and exit.",
)
def scan(nats: tuple[list[str], ...], embedded: bool, store: Path | None, **options: Any) -> None:
    """Run the NATS service, which polls Modbus devices for subscribers.

    Connects to a device when a client subscribes to its tags, and disconnects after the last
    subscriber leaves. Runs until Ctrl-C, SIGTERM or a message to PREFIX.shutdown. On SIGHUP, the
    files of the options are read anew. Exit codes: 0 stopped, 1 failed, 2 wrong usage, or refused
    by the other nodes of the fleet.
    """
    urls = [url for each in nats for url in each] or server_urls(os.environ.get("NATS_SERVERS", ""))
    servers = _identity(tuple(urls) or (DEFAULT_URL,), options)
    trust = _tls("device", options)
    allow = _allowed(options["allow"])
    if options["deadband"] and options["publish"] != "change":
        raise click.UsageError("--deadband requires --publish change.")
    try:
        check_dialect(options["dialect"], options["prefix"])
    except ValueError as error:
        raise click.BadParameter(f"{error}.", param_hint="'--prefix'") from None
    _check_fleet(options)
    if store is not None and not embedded:
        raise click.UsageError("--store requires --embedded.")
    logs.configure(options["log_level"], options["log_format"])
    limits = ScannerLimits(devices=options["max_devices"], tags=options["max_tags"])
    allow_open_files(limits.connections)
    with ExitStack() as stack:
        check: Callable[[], None] | None = None
        try:
            device_tls.check(trust)
            if embedded:
                server = stack.enter_context(TemporaryServer(_embedded_port(servers), store))
                servers, check = Servers((server.url,)), server.check
            settings = _settings(options, servers, allow, limits, trust)
            click.echo(_greeting(settings))
            event_loop.run(_serve(settings, check))
        except FleetRefused as refused:
            click.echo(f"holdfast: fleet {options['fleet']}: {refused}", err=True)
            sys.exit(REFUSED)
        except OSError as error:
            click.echo(f"holdfast: {error}", err=True)
            sys.exit(FAILED)


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
    limits: ScannerLimits,
    trust: Tls,
) -> Settings:
    return Settings(
        servers,
        options["prefix"],
        allow,
        limits,
        trust,
        defaults=Defaults(
            options["timeout"], options["publish"], options["deadband"], options["scan_rate"]
        ),
        writes=options["writes"],
        strict=options["strict"],
        ping=Ping(options["ping_interval"], options["ping_outstanding"]),
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
        raise click.BadParameter(f"{error}.", param_hint="'--allow'") from None
    only_lines = listed and not any(isinstance(entry, AllowedNetwork) for entry in listed)
    return (*listed, *PRIVATE) if only_lines else listed


def _identity(urls: tuple[str, ...], options: dict[str, Any]) -> Servers:
    """The servers and credentials. Raises a usage error for conflicting options."""
    if options["password_file"] is not None and options["user"] is None:
        raise click.UsageError("--password-file requires --user.")
    ways = [key for key in ("user", "token_file", "creds") if options[key] is not None]
    if len(ways) > 1:
        given = " and ".join(f"--{key.replace('_', '-')}" for key in ways)
        raise click.UsageError(f"{given} can't be used together.")
    return Servers(
        urls,
        options["user"],
        options["password_file"],
        options["token_file"],
        options["creds"],
        _tls("tls", options),
    )


def _tls(prefix: str, options: dict[str, Any]) -> Tls:
    return tls_of(prefix, *(options[f"{prefix}_{key}"] for key in ("ca", "cert", "key")))


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
    logs.write(logging.INFO, "started", version=__version__)
    while await _scan(settings, check, signals):
        pass
    logs.tell_held_back(all_of_them=True)
    logs.write(logging.INFO, "stopped")


async def _scan(settings: Settings, check: Callable[[], None] | None, signals: Signals) -> bool:
    """Runs a scanner. Returns whether it ended because of files that have changed."""
    scanner, known, clock = Scanner(settings), _contents(settings), WallClock()
    running = asyncio.create_task(scanner.run())
    changed = False
    reading: FileWork[bool] | None = None
    while not running.done():
        await asyncio.wait([running], timeout=JOIN_TIMEOUT)
        logs.tell_held_back()
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
    return changed and not signals.received


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
    device_tls.check(settings.device_tls)
    return _contents(settings) != known


def _taken_over(reading: FileWork[bool]) -> bool:
    """Whether the files have changed and can be used. Logs what it finds."""
    try:
        changed = reading.result()
    except OSError as error:
        logs.write(logging.ERROR, "reload_refused", problem=str(error))
        return False
    logs.write(logging.INFO, "reloaded", changed="files" if changed else "nothing")
    return changed


def _greeting(settings: Settings) -> str:
    prefix, fleet = settings.prefix, settings.fleet
    is_next = settings.dialect == "tentacle-next"
    data = f"{prefix}.data.DEVICE.TAG" if is_next else f"{prefix}.data.DEVICE"
    lines = [
        f"Scanning for subscribers at {', '.join(_without_secrets(settings.servers))}.",
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
    """What may be written: without this, nobody expects that every client may."""
    found = settings.write_access
    yield f"  writes     {found['tags']}"
    for key in ("by", "narrowed_by", "set_by"):
        if key in found:
            yield f"             {key.replace('_', ' ')} {found[key]}"


def _without_secrets(servers: Servers) -> Iterator[str]:
    return (str(_server(url)) for url in servers.urls)
