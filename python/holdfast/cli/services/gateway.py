"""`holdfast gateway`: serves Modbus devices over HTTP, with a web console, without a file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from holdfast.appliance.services.gateway import gateway_settings
from holdfast.appliance.services.services import https as loaded_https
from holdfast.cli.options.bind_and_source import bind_option, require_source, source_option
from holdfast.cli.options.log_lines import log_format_option
from holdfast.cli.options.option import choice, number_option, option, parsed_by
from holdfast.cli.options.tls import DEVICES, https_options, tls_options
from holdfast.cli.services.run import serve
from holdfast.cli.shell_command import shell_command
from holdfast.client.endpoint import check_files
from holdfast.config import Config
from holdfast.config.models.services import Compat
from holdfast.config.values.allow_entries import parse_allowed
from holdfast.config.values.host_names import parse_host_name
from holdfast.gateway import token_file
from holdfast.net.addresses import LOOPBACK, joined, reachable
from holdfast.protocol import PORT
from holdfast.types import Access

if TYPE_CHECKING:
    from holdfast.appliance import Appliance
    from holdfast.config.values.ip_addresses import Bind
    from holdfast.events import Format
    from holdfast.gateway import Settings
    from holdfast.net.addresses import Network
    from holdfast.net.allow_list import AllowedNetwork
    from holdfast.net.tls import Tls


_ALLOW = """Devices that the gateway may connect to; repeatable. Default ports: 502, with TLS also
802; `*`: all ports."""
_TOKENS = "Require a token from this file: lines `NAME SHA256`, as from `holdfast token --line`."
_HOST = "Name under which clients without tokens may reach the gateway; repeatable."


@click.command(epilog="Example: holdfast gateway --allow 10.0.0.0/8 --allow 10.0.0.5:5020")
@bind_option(8090, "Address and port to listen on.")
@option(
    "--allow", "NETWORK[:PORTS]", _ALLOW, parsed_by(parse_allowed), multiple=True, required=True
)
@choice("--access", "read-write: requests may write to devices.", get_args(Access), "read-only")
@option("--tokens token_file", "FILE", _TOKENS, click.Path(path_type=Path))
@source_option
@option("--host hosts", "NAME", _HOST, parsed_by(parse_host_name), multiple=True)
@choice("--compat", "Accept the requests of this program, and send its errors.", get_args(Compat))
@tls_options("device", "device_tls", DEVICES, " for devices")
@https_options
@number_option("--in-flight", "Requests in flight to one device.", 1, 64, 1)
@log_format_option
def gateway(
    bind: Bind,
    allow: tuple[AllowedNetwork, ...],
    access: Access,
    token_file: Path | None,
    sources: tuple[Network, ...],
    hosts: tuple[str, ...],
    compat: Compat | None,
    device_tls: Tls,
    https: dict[str, Path] | None,
    in_flight: int,
    log_format: Format,
) -> None:
    """Serve Modbus devices over HTTP, with a web console.

    The gateway only connects to networks and ports in --allow: 10.0.0.0/8, 10.0.0.5:5020,
    10.0.0.0/24:502-510, 10.0.0.5:*, [fd00::]/8:502. The addresses of a host name must be in the
    list. With --access read-write, the gateway also writes.

    By default, only clients on this machine may connect. Others (--source) require --tokens.
    Without it, a URL has an IP address, localhost, or a name of --host.

    With TLS, certificates of devices are verified with --device-ca. Devices that require a
    client certificate receive --device-cert.

    With --https-cert and --https-key, clients of the gateway use HTTPS.

    On SIGHUP, the token file and the TLS files are read anew. This is `holdfast run` with a gateway
    alone; a configuration file allows more services.

    Exit codes: 0 stopped by a signal, 1 can't listen, 2 wrong usage.
    """
    require_source(bind, sources)
    sources = sources or LOOPBACK

    def load() -> Config:
        """Reads the files of the options."""
        found = [] if token_file is None else _tokens(token_file)
        if not found and any(not each.is_loopback for each in sources):
            raise click.UsageError("--source beyond this machine requires --tokens.")
        settings: dict[str, Any] = {
            "bind": bind,
            "sources": list(sources),
            "allow": list(allow),
            "access": access,
            "tokens": [{"name": name, "sha256": digest.hex()} for name, digest in found] or "none",
            "in_flight": in_flight,
        }
        settings |= {"hosts": list(hosts)} if hosts else {}
        settings |= {"compat": compat} if compat is not None else {}
        if https is not None:
            settings["tls"] = https
        if files := {f"{name}_file": Path(file) for name, file in device_tls.files()}:
            settings["device_tls"] = files
        log = {"format": log_format}
        return _checked(Config.model_validate({"gateway": settings, "log": log}))

    serve(load(), _greeting, load=load, retries_ports=False)


def _tokens(file: Path) -> tuple[token_file.Token, ...]:
    try:
        return tuple(token_file.load(file))
    except OSError as error:
        raise click.BadParameter(
            f"{file}: {error.strerror or error}", param_hint="'--tokens'"
        ) from error
    except token_file.WrongTokens as error:
        raise click.BadParameter(str(error), param_hint="'--tokens'") from error


def _checked(config: Config) -> Config:
    """Raises `click.UsageError` for TLS files that can't be used."""
    gateway = config.gateway
    assert gateway is not None
    try:
        if gateway.device_tls is not None:
            check_files(gateway.device_tls.files)
    except (OSError, ValueError) as error:
        raise click.UsageError(f"TLS for devices: {error}") from error
    try:
        if gateway.tls is not None:
            loaded_https(gateway.tls)
    except ValueError as error:
        raise click.UsageError(f"HTTPS: {error}") from error
    return config


def _greeting(appliance: Appliance) -> str:
    [listening] = appliance.endpoints()
    settings = appliance.config.gateway
    assert settings is not None
    assert listening.port is not None
    place = listening.type, listening.host, listening.port
    return _greeting_text(*place, gateway_settings(settings))


def _greeting_text(scheme: str, host: str, port: int, settings: Settings) -> str:
    url = f"{scheme}://{joined(reachable(host, settings.sources), port)}"
    can = "reads and writes" if settings.writes else "reads"
    who = ", ".join(name for name, _ in settings.tokens) or "no tokens"
    example, its_port = _example(settings.allow[0])
    body = f'{{"host":"{example}","port":{its_port}}}'
    header = shell_command("-H", "Content-Type: application/json")
    if settings.tokens:
        token = "%TOKEN%" if sys.platform == "win32" else "$TOKEN"
        header += f' -H "Authorization: Bearer {token}"'
    if scheme == "https":
        header += " --cacert ca.pem"
    names = [f"  names: {', '.join(sorted(settings.hosts))}"] if settings.hosts else []
    form = [f"  compatible with: {settings.compat}"] if settings.compat is not None else []
    return "\n".join(
        [
            f"Console: {url}/, API documentation: {url}/docs",
            "",
            f"  {can} devices at {', '.join(map(str, settings.allow))}",
            f"  clients: {', '.join(map(str, settings.sources))}; {who}",
            *names,
            *form,
            "",
            "Try:",
            "",
            f"  curl {url}/api/modbus/connect {header} -d {shell_command(body)}",
            "",
            "Ctrl-C stops it.",
        ]
    )


def _example(entry: AllowedNetwork) -> tuple[str, int]:
    """A host and a port that the entry allows."""
    network, (first, last) = entry.network, entry.ports or (PORT, PORT)
    if network.prefixlen == 0:
        host = "plc.local"
    else:
        host = str(network[1] if network.num_addresses > 2 else network[0])
    return host, PORT if first <= PORT <= last else first
