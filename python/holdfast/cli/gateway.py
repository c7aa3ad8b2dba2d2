"""`holdfast gateway`: serves Modbus devices over HTTP, with a web console, without a file."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from holdfast.appliance import assembly
from holdfast.cli.log_options import log_config, log_options
from holdfast.cli.parsing import by
from holdfast.cli.run import serve
from holdfast.cli.tls_options import DEVICES, https_config, https_options, tls_of, tls_options
from holdfast.client.endpoint import check_files
from holdfast.config import Config
from holdfast.config.egress import parse_allowed
from holdfast.config.host_names import parse_host_name
from holdfast.config.ip_addresses import parse_bind, parse_source
from holdfast.config.services import Compat
from holdfast.gateway import tokens
from holdfast.net.addresses import LOOPBACK, joined, reachable, unbracketed
from holdfast.protocol import PORT

if TYPE_CHECKING:
    from holdfast.appliance import Appliance
    from holdfast.config.ip_addresses import Bind
    from holdfast.gateway import Settings
    from holdfast.logs import Format
    from holdfast.net.addresses import Network
    from holdfast.net.allow_list import AllowedNetwork


@click.command(epilog="Example: holdfast gateway --allow 10.0.0.0/8 --allow 10.0.0.5:5020")
@click.option(
    "--bind",
    type=by(parse_bind),
    default="127.0.0.1:8090",
    show_default=True,
    metavar="ADDRESS:PORT",
    help="Address and port to listen on.",
)
@click.option(
    "--allow",
    type=by(parse_allowed),
    multiple=True,
    required=True,
    metavar="NETWORK[:PORTS]",
    help="Devices that the gateway may connect to; repeatable. Default ports: 502, with TLS also "
    "802; `*`: all ports.",
)
@click.option("--writes", is_flag=True, help="Allow requests to write to devices.")
@click.option(
    "--token-file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Require a token from this file: lines `NAME SHA256`, as from `holdfast token --line`.",
)
@click.option(
    "--sources",
    type=by(parse_source),
    multiple=True,
    default=[str(each) for each in LOOPBACK],
    show_default="this machine",
    metavar="NETWORK",
    help="Clients that may connect to the gateway; repeatable.",
)
@click.option(
    "--hosts",
    type=by(parse_host_name),
    multiple=True,
    metavar="NAME",
    help="Names under which clients without tokens may reach the gateway; repeatable.",
)
@click.option(
    "--compat",
    type=click.Choice(get_args(Compat)),
    help="Accept the requests of this program, and send its errors.",
)
@tls_options("tls", DEVICES, " for devices")
@https_options
@click.option(
    "--in-flight",
    type=click.IntRange(1, 64),
    default=1,
    show_default=True,
    metavar="N",
    help="Requests in flight to one device.",
)
@log_options
def gateway(
    bind: Bind,
    allow: tuple[AllowedNetwork, ...],
    writes: bool,
    token_file: Path | None,
    sources: tuple[Network, ...],
    hosts: tuple[str, ...],
    compat: Compat | None,
    tls_ca: str | None,
    tls_cert: str | None,
    tls_key: str | None,
    https_cert: Path | None,
    https_key: Path | None,
    https_passphrase_file: Path | None,
    https_client_ca: Path | None,
    in_flight: int,
    log_format: Format,
    json_log: bool,
) -> None:
    """Serve Modbus devices over HTTP, with a web console.

    The gateway only connects to networks and ports in --allow: 10.0.0.0/8, 10.0.0.5:5020,
    10.0.0.0/24:502-510, 10.0.0.5:*, [fd00::]/8:502. The addresses of a host name must be in the
    list. Without --writes, the gateway only reads.

    By default, only clients on this machine may connect. Other --sources require --token-file.
    Without it, a URL has an IP address, localhost, or a name in --hosts.

    With TLS, certificates of devices are verified with --tls-ca. Devices that require a client
    certificate receive --tls-cert.

    With --https-cert and --https-key, clients of the gateway use HTTPS.

    On SIGHUP, the token file and the TLS files are read anew. This is `holdfast run` with a gateway
    alone; a configuration file allows more services.

    Exit codes: 0 stopped by a signal, 1 can't listen, 2 wrong usage.
    """
    https = https_config(https_cert, https_key, https_passphrase_file, https_client_ca)
    device_tls = _device_tls(tls_ca, tls_cert, tls_key)
    log = log_config(log_format, json_log)

    def load() -> Config:
        """Reads the files of the options."""
        found = [] if token_file is None else _tokens(token_file)
        if not found and any(not each.is_loopback for each in sources):
            raise click.UsageError("--sources beyond this machine require --token-file.")
        settings: dict[str, Any] = {
            "bind": bind,
            "sources": list(sources),
            "allow": list(allow),
            "access": "read-write" if writes else "read-only",
            "tokens": [{"name": name, "sha256": digest.hex()} for name, digest in found] or "none",
            "in_flight": in_flight,
        }
        settings |= {"hosts": list(hosts)} if hosts else {}
        settings |= {"compat": compat} if compat is not None else {}
        if https is not None:
            settings["tls"] = https
        if device_tls is not None:
            settings["device_tls"] = device_tls
        return _checked(Config.model_validate({"gateway": settings, "log": log}))

    serve(load(), _greeting, named="gateway", load=load, retries_ports=False)


def _tokens(file: Path) -> tuple[tokens.Token, ...]:
    try:
        return tuple(tokens.load(file))
    except OSError as error:
        raise click.BadParameter(
            f"{file}: {error.strerror or error}.", param_hint="'--token-file'"
        ) from error
    except tokens.WrongTokens as error:
        raise click.BadParameter(f"{error}.", param_hint="'--token-file'") from error


def _device_tls(ca: str | None, cert: str | None, key: str | None) -> dict[str, Path] | None:
    """The TLS files for devices, as in a configuration."""
    files = tls_of("tls", ca, cert, key)
    named = {"ca_file": files.ca, "cert_file": files.cert, "key_file": files.key}
    return {key: Path(file) for key, file in named.items() if file is not None} or None


def _checked(config: Config) -> Config:
    """Raises `click.UsageError` for TLS files that can't be used."""
    gateway = config.gateway
    assert gateway is not None
    try:
        if gateway.device_tls is not None:
            check_files(assembly.gateway_tls(gateway))
    except (OSError, ValueError) as error:
        raise click.UsageError(f"TLS for devices: {error}.") from error
    try:
        if gateway.tls is not None:
            assembly.https(gateway.tls)
    except ValueError as error:
        raise click.UsageError(f"HTTPS: {error}.") from error
    return config


def _greeting(appliance: Appliance) -> str:
    [listening] = appliance.endpoints()
    settings = appliance.config.gateway
    assert settings is not None
    assert listening.port is not None
    served = f"{listening.type}://{joined(listening.host, listening.port)}"
    return _told(served, assembly.gateway(settings))


def _told(served: str, settings: Settings) -> str:
    scheme, _, address = served.partition("://")
    at, _, port = address.rpartition(":")
    url = f"{scheme}://{joined(reachable(unbracketed(at)), int(port))}"
    can = "reads and writes" if settings.writes else "reads"
    who = ", ".join(name for name, _ in settings.tokens) or "no tokens"
    example, its_port = _example(settings.allow[0])
    body = f'{{"host":"{example}","port":{its_port}}}'
    header = "-H 'Content-Type: application/json'"
    if settings.tokens:
        header += ' -H "Authorization: Bearer $TOKEN"'
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
            f"  curl {url}/api/modbus/connect {header} -d {shlex.quote(body)}",
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
