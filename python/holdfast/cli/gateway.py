"""`holdfast gateway`: serves Modbus devices over HTTP, with a web console, until a signal."""

from __future__ import annotations

import shlex
import sys
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast import logs
from holdfast.cli.parsing import by
from holdfast.cli.run import JOIN_TIMEOUT
from holdfast.cli.signals import Signals
from holdfast.cli.tls_options import DEVICES, https_of, https_options, tls_of, tls_options
from holdfast.client.endpoint import check_files
from holdfast.config.egress import parse_allowed
from holdfast.config.ip_addresses import parse_bind, parse_source
from holdfast.gateway import Gateway, GatewayLimits, Settings, tokens
from holdfast.net.addresses import LOOPBACK, joined, reachable, unbracketed
from holdfast.net.tls import NO_FILES
from holdfast.protocol import PORT
from holdfast.stop import Stop
from holdfast.web.port import explained, listen

if TYPE_CHECKING:
    import socket
    from concurrent.futures import Future

    from holdfast.config.ip_addresses import Bind
    from holdfast.net.addresses import Network
    from holdfast.net.allow_list import AllowedNetwork
    from holdfast.net.tls import Tls
    from holdfast.web.https import Https

FAILED = 1


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
@click.option("--json-log", is_flag=True, help="Log one JSON object per line.")
def gateway(
    bind: Bind,
    allow: tuple[AllowedNetwork, ...],
    writes: bool,
    token_file: Path | None,
    sources: tuple[Network, ...],
    tls_ca: str | None,
    tls_cert: str | None,
    tls_key: str | None,
    https_cert: Path | None,
    https_key: Path | None,
    https_passphrase_file: Path | None,
    https_client_ca: Path | None,
    in_flight: int,
    json_log: bool,
) -> None:
    """Serve Modbus devices over HTTP, with a web console.

    The gateway only connects to networks and ports in --allow: 10.0.0.0/8, 10.0.0.5:5020,
    10.0.0.0/24:502-510, 10.0.0.5:*, [fd00::]/8:502. The addresses of a host name must be in the
    list. Without --writes, the gateway only reads.

    By default, only clients on this machine may connect. Other --sources require --token-file.

    With TLS, certificates of devices are verified with --tls-ca. Devices that require a client
    certificate receive --tls-cert.

    With --https-cert and --https-key, clients of the gateway use HTTPS.

    Exit codes: 0 stopped by a signal, 1 can't listen, 2 wrong usage.
    """
    settings = Settings(
        allow=allow,
        writes=writes,
        tokens=() if token_file is None else _tokens(token_file),
        sources=sources,
        limits=replace(GatewayLimits(), in_flight=in_flight),
        tls=_tls(tls_ca, tls_cert, tls_key),
    )
    if not settings.tokens and any(not each.is_loopback for each in sources):
        raise click.UsageError("--sources beyond this machine require --token-file.")
    https = https_of(https_cert, https_key, https_passphrase_file, https_client_ca)
    logs.configure("info", "json" if json_log else "text")
    signals = Signals()
    try:
        listener = listen(bind.host, bind.port)
    except OSError as error:
        click.echo(f"holdfast: can't listen on {bind}: {explained(error)}", err=True)
        sys.exit(FAILED)
    with listener:
        _serve(settings, listener, signals, https)


def _serve(
    settings: Settings, listener: socket.socket, signals: Signals, https: Https | None
) -> None:
    """Serves in a thread until a signal arrives."""
    served = Gateway(settings, listener, https=https)
    stop = Stop()
    with ThreadPoolExecutor(1, "gateway") as threads:
        running: Future[None] = threads.submit(served.run, stop)
        click.echo(_greeting(served.url, settings))
        while not signals.received and not running.done():
            wait_for([running], JOIN_TIMEOUT)
            logs.tell_held_back()
        stop.set()
        running.result()


def _tokens(file: Path) -> tuple[tokens.Token, ...]:
    try:
        return tuple(tokens.load(file))
    except OSError as error:
        raise click.BadParameter(
            f"{file}: {error.strerror or error}.", param_hint="'--token-file'"
        ) from error
    except tokens.WrongTokens as error:
        raise click.BadParameter(f"{error}.", param_hint="'--token-file'") from error


def _tls(ca: str | None, cert: str | None, key: str | None) -> Tls:
    """The TLS files, checked."""
    tls = tls_of("tls", ca, cert, key)
    if tls != NO_FILES:
        try:
            check_files(tls)
        except (OSError, ValueError) as error:
            raise click.UsageError(f"TLS for devices: {error}.") from error
    return tls


def _greeting(served: str, settings: Settings) -> str:
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
    return "\n".join(
        [
            f"Console: {url}/, API documentation: {url}/docs",
            "",
            f"  {can} devices at {', '.join(map(str, settings.allow))}",
            f"  clients: {', '.join(map(str, settings.sources))}; {who}",
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
