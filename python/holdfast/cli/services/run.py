"""`holdfast run`: runs an appliance until a signal."""

from __future__ import annotations

import logging
import os
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from holdfast._core import UnusableMemoryFile
from holdfast.adapters.plugins import UnknownAdapter
from holdfast.appliance import Appliance
from holdfast.appliance.control import Control, is_running
from holdfast.appliance.parts.shared_logs import LogNotJoined
from holdfast.appliance.service_manager import ServiceManager
from holdfast.cli.configuration import load_or_exit, load_whole
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import config_argument
from holdfast.cli.options.plc_addresses import MODICON_AREAS
from holdfast.cli.services.open_files import allow_open_files
from holdfast.cli.services.reloader import Reloader
from holdfast.cli.shell_command import shell_command
from holdfast.cli.signals import SIGNAL_INTERVAL_S, Interrupted, Signals
from holdfast.cli.terminal_text import ranges_shown
from holdfast.config.models.listeners import ModbusTcpListener, RouteConfig, UnitMemoryConfig
from holdfast.config.models.services import GatewayConfig
from holdfast.config.unit_rights import unit_rights
from holdfast.config.values.scanner_settings import written_pollable
from holdfast.events import log_lines
from holdfast.events.writer import announce
from holdfast.net.addresses import joined, reachable
from holdfast.protocol import WRITE_LIMITS
from holdfast.runtime.bounded_files import Unreadable
from holdfast.runtime.interpreter import freeze_garbage_collector, lengthen_switch_interval
from holdfast.runtime.text import file_error_text
from holdfast.types import BIT_AREAS, REGISTER_AREAS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from holdfast.appliance.parts.listeners import ListenAddress
    from holdfast.appliance.windows_service.control import ServiceControl
    from holdfast.config import Config
    from holdfast.config.models.devices import DeviceConfig
    from holdfast.config.models.listeners import RawRuleConfig, RuleConfig, SerialRuleConfig
    from holdfast.config.models.outputs import Output
    from holdfast.config.models.services import NatsConfig
    from holdfast.config.unit_rights import UnitRights
    from holdfast.types import Area

# Who ends a connection at a request of `holdfast sessions`, in the audit log.
SOURCE = {"source": "holdfast sessions"}

# Maximum number of devices in the greeting.
MAX_DEVICES_SHOWN = 10

# mbpoll's number for each area. Registers come first, as they are the better example.
MBPOLL_TYPES = {
    area: number
    for preferred in (REGISTER_AREAS, BIT_AREAS)
    for number, area in MODICON_AREAS.items()
    if area in preferred
}


@click.command(epilog="Example: holdfast run examples/plant.yaml")
@config_argument
def run(file: Path) -> None:
    """Run the appliance with the configuration FILE.

    Prints listeners and polled devices, then serves until Ctrl-C or SIGTERM. Exit codes: 0 stopped
    by a signal, 1 another start may succeed, as with a port that was taken, or the stop could not
    store confirmed writes, 2 the configuration or a file has errors. The ports of REST, gateway and
    metrics are retried until they are free.
    """
    config = load_or_exit(file, shows_warnings=False)
    serve(config, lambda appliance: _greeting(appliance, file), file=file)


@contextmanager
def _threads_or_exit() -> Iterator[None]:
    """Exits with 1 if the system allows no more threads, as by `TasksMax=` of a unit."""
    try:
        yield
    except RuntimeError as error:
        # Python has no type or number for it, only this text.
        if str(error) != "can't start new thread":
            raise
        fail(error)


@_threads_or_exit()
def serve(
    config: Config,
    greeting: Callable[[Appliance], str],
    *,
    file: Path | None = None,
    load: Callable[[], Config] | None = None,
    retries_ports: bool = True,
    control: ServiceControl | None = None,
) -> None:
    """Runs an appliance until a signal. Exits with 1 or 2 if it can't start, and with 1 if the stop
    could not store confirmed writes.

    With `file`, it is reread at SIGHUP, at a request of `holdfast reload`, or when it changes. With
    `load`, what it returns is taken over at SIGHUP. Without `retries_ports`, a port of HTTP that is
    in use is an error. With `control`, requests of Windows take the place of signals.
    """
    log_lines.configure(config.log.level, config.log.format)
    for warning in config.warnings:
        log_lines.write(logging.WARNING, "config_warning", warning=str(warning))
    if file is not None and is_running(file):
        _fail_as_run(file)
    lengthen_switch_interval()
    allow_open_files(config, file)
    signals = control or Signals(
        reload="always" if file else "with a terminal" if load else "never"
    )
    manager = control or ServiceManager()
    appliance = Appliance(config, retries_ports=retries_ports)
    # A start may take long. What changes meanwhile is noticed after it.
    reloading: Reloader | None = None
    if file is not None:
        reloading = Reloader(appliance, manager, lambda: load_whole(file), file)
    elif load is not None:
        reloading = Reloader(appliance, manager, load)
    try:
        with signals.interrupting():
            appliance.start()
    except Interrupted:
        appliance.stop()
        return
    except UnusableMemoryFile as error:
        fail(error, ExitCode.WRONG)
    except LogNotJoined as error:
        fail(error, ExitCode.WRONG if error.is_permanent else ExitCode.FAILED)
    except Unreadable as error:
        fail(error)
    except OSError as error:
        fail(file_error_text(error))
    except UnknownAdapter as error:
        fail(f"{file}: {error}", ExitCode.WRONG)
    with ExitStack() as parts:
        parts.callback(manager.close)
        parts.callback(appliance.stop)
        parts.callback(manager.stopping)
        if reloading is not None:
            parts.callback(reloading.close)
        if reloading is not None and file is not None:
            parts.callback(_control(appliance, reloading, file))
        freeze_garbage_collector()
        announce(greeting(appliance))
        manager.ready()
        while not signals.received:
            appliance.log_events(timeout=SIGNAL_INTERVAL_S)
            if appliance.is_live:
                manager.feed_watchdog()
            if reloading is not None:
                reloading.step(requested=signals.take_reload())
    if appliance.lost_writes:
        sys.exit(ExitCode.FAILED)


def _control(appliance: Appliance, reloading: Reloader, file: Path) -> Callable[[], object]:
    """Opens the control socket. Returns what closes it. Without one, all the rest still works.

    Exits with 1 if another process runs this configuration: both began at the same time.
    """
    handlers: dict[str, Callable[..., Mapping[str, Any]]] = {
        "reload": reloading.ask,
        "sessions": lambda: {"sessions": appliance.sessions()},
        "probe_url": lambda: {"found": appliance.probe_url()},
        "replicas": lambda: {"logs": appliance.replicas()},
        "end": lambda listener, id: {"ended": appliance.end_session(listener, id, SOURCE)},
    }
    try:
        return Control(file, handlers).close
    except OSError as error:
        if is_running(file):
            _fail_as_run(file)
        log_lines.write(logging.WARNING, "control_unavailable", reason=str(error))
        return lambda: None


def _fail_as_run(file: Path) -> NoReturn:
    """Exits: two would poll the same devices, and send each value twice."""
    fail(f"{file}: another appliance of this user runs it on this machine")


def _greeting(appliance: Appliance, file: Path) -> str:
    endpoints, config = appliance.endpoints(), appliance.config
    devices, nats = list(config.devices.items()), config.nats
    shown = devices[:MAX_DEVICES_SHOWN]
    names = [*(endpoint.name for endpoint in endpoints), *(name for name, _ in shown)]
    names += [*config.links, *config.outputs, *([] if nats is None else ["nats"])]
    width = max(map(len, names), default=0)
    lines = [f"{file} is served:", ""]
    for endpoint in endpoints:
        lines.append(f"  {endpoint.name:{width}}  {_address(endpoint)}")
        if endpoint.error is not None:
            lines.append(f"  {'':{width}}    not served yet, retried: {endpoint.error}")
        rules = getattr(endpoint.settings, "rules", ())
        lines += [f"  {'':{width}}    {_granted(rule)}" for rule in rules]
        if isinstance(endpoint.settings, GatewayConfig):
            lines.append(f"  {'':{width}}    {_reached(endpoint.settings)}")
    if nats is not None:
        lines.append(f"  {'nats':{width}}  {', '.join(nats.servers)}")
        lines.append(f"  {'':{width}}    {_scanned(nats)}")
    lines += [f"  {name:{width}}  {link.url}" for name, link in config.links.items()]
    lines += [f"  {name:{width}}  {_polled(device)}" for name, device in shown]
    if len(devices) > len(shown):
        lines.append(f"  and {len(devices) - len(shown)} more devices")
    lines += [f"  {name:{width}}  {_published(output)}" for name, output in config.outputs.items()]
    lines += ["", "Try:", ""]
    lines += [f"  {command}" for command in _suggestions(appliance, endpoints, file)]
    return "\n".join([*lines, "", "Ctrl-C stops it."])


def _address(endpoint: ListenAddress) -> str:
    if endpoint.port is None:
        return f"{endpoint.type}  {endpoint.host}"
    address = joined(endpoint.host, endpoint.port)
    if endpoint.type in ("http", "https"):
        return f"{endpoint.type}://{address}"
    return f"{endpoint.type}  {address}"


def _polled(device: DeviceConfig) -> str:
    """The polling of a device, in one line."""
    if not device.enabled:
        return f"{device.url} unit {device.unit}, not polled"
    if device.interval is None or not device.has_readings:
        return f"{device.url} unit {device.unit}, by routes only"
    return f"{device.url} unit {device.unit}, polled every {device.interval:g} s"


def _published(output: Output) -> str:
    """The destination of an output, in one line."""
    servers = getattr(output, "servers", ())
    to = getattr(output, "url", None) or ", ".join(servers) or str(getattr(output, "file", ""))
    return f"{output.type}  {to}"


def _reached(gateway: GatewayConfig) -> str:
    """The access that the gateway gives, in one line."""
    can = "reads and writes" if gateway.access == "read-write" else "reads"
    sources = ", ".join(map(str, gateway.sources))
    tokens = "no tokens" if gateway.tokens == "none" else "a token each"
    return f"console and API; {can} {', '.join(map(str, gateway.allow))} for {sources}; {tokens}"


def _scanned(nats: NatsConfig) -> str:
    """The devices and subject of the scanner, in one line."""
    devices = ", ".join(map(written_pollable, nats.devices))
    return f"polls and writes {devices} for subscribers at {nats.prefix}.subscribe"


def _granted(rule: RuleConfig | SerialRuleConfig | RawRuleConfig) -> str:
    """The access that a rule gives, in one line."""
    units = ", ".join(f"{key} = {_behind(target)}" for key, target in rule.units.items())
    to = f"units {units}" if units else f"memories {', '.join(getattr(rule, 'memories', ()))}"
    rights = getattr(rule, "access", None) or f"writes {', '.join(getattr(rule, 'areas', ()))}"
    sources = ", ".join(str(source) for source in getattr(rule, "sources", ()))
    roles = getattr(rule, "roles", None)
    of = "" if roles is None else f" as {', '.join(role or 'no role' for role in roles)}"
    return f"{to}; {rights} for {sources or 'the line'}{of}"


def _behind(target: str | UnitMemoryConfig | RouteConfig) -> str:
    """The memory or device behind a unit id, and its own rights."""
    if isinstance(target, str):
        return target
    name = target.route if isinstance(target, RouteConfig) else target.memory
    own: list[str] = [] if target.access is None else [target.access]
    for key in ("functions", "deny"):
        codes = getattr(target, key)
        own += [] if codes is None else [f"{key} {', '.join(map(str, codes))}"]
    if isinstance(target, UnitMemoryConfig):
        own += [] if target.read is None else [f"reads {ranges_shown(target.read)}"]
        own += [] if target.write is None else [f"writes {ranges_shown(target.write)}"]
        bits = target.exception_status
        own += [] if bits is None else [f"exception status {ranges_shown([bits])}"]
    return f"{name} ({'; '.join(own)})" if own else name


def _suggestions(appliance: Appliance, endpoints: list[ListenAddress], file: Path) -> list[str]:
    """Example commands for this appliance: a read, a write if one is allowed, the check."""
    check = f"{_program()} {shell_command('check', file)}"
    for endpoint in endpoints:
        if not isinstance(endpoint.settings, ModbusTcpListener):
            continue
        for rule in endpoint.settings.rules:
            unit, rights = next(unit_rights(rule))
            place = f"mbpoll -m tcp -p {endpoint.port} -a {unit} -0"
            host = reachable(endpoint.host, rule.sources)
            if rights.memory is None:
                return [f"{place} -t 4 -r 0 -c 1 -1 {host}", check]
            area, addresses = _example(appliance.memories[rights.memory].areas, rights)
            command = f"{place} -t {MBPOLL_TYPES[area]} -r {addresses.start}"
            read = f"{command} -c {min(len(addresses), 5)} -1 {host}"
            writable = rights.access == "read-write" and area in WRITE_LIMITS
            writable = writable and rights.write is None
            return [read, f"{command} {host} 1", check] if writable else [read, check]
    return [check]


def _example(areas: Mapping[Area, range], rights: UnitRights) -> tuple[Area, range]:
    """The area, and addresses of it, of the command that reads."""
    if rights.read is not None:
        return rights.read[0].area, rights.read[0].addresses
    preferred = next((area for area in MBPOLL_TYPES if area in areas), None)
    area = next(iter(areas)) if preferred is None else preferred
    return area, areas[area]


def _program() -> str:
    """The name with which this program was called, or its path if a shell can't find it."""
    name = click.get_current_context().find_root().info_name or "holdfast"
    if name == "holdfast" and Path(sys.argv[0]).parent not in map(Path, os.get_exec_path()):
        try:
            return shell_command(os.path.relpath(sys.argv[0]))
        except ValueError:  # Windows has no way from one drive to another.
            return shell_command(sys.argv[0])
    return name
