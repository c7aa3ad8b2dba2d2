"""`holdfast health`: asks a running appliance whether it is ready, for scripts and containers."""

from __future__ import annotations

import contextlib
import http.client
import json
import ssl
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from holdfast.bounded_files import require_stored
from holdfast.cli.showing import plain, table
from holdfast.cli.tls_options import tls_of, tls_options
from holdfast.net.addresses import joined, reachable
from holdfast.web import health as probes

if TYPE_CHECKING:
    from holdfast.net.tls import Tls

MAX_ANSWER = 1 << 20
"""The most bytes of an answer that are read."""

SERVICES = ("metrics", "gateway")
"""The sections of services that answer probes, the one to ask first."""


class _NoAnswer(Exception):
    """The appliance has not answered a probe."""


@click.command(epilog="Example: holdfast health plant.yaml")
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option("--url", metavar="URL", help="Ask here, as in http://127.0.0.1:9464, without FILE.")
@click.option(
    "--live", is_flag=True, help="Ask whether it is live, instead of whether it is ready."
)
@click.option(
    "--timeout",
    type=click.FloatRange(0.1, 3600),
    default=4.0,
    show_default=True,
    metavar="SECONDS",
    help="Time for the whole answer.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs.")
@tls_options("tls", "Trusted authorities of the service.")
def health(
    file: Path | None,
    url: str | None,
    live: bool,
    timeout: float,
    as_json: bool,
    tls_ca: str | None,
    tls_cert: str | None,
    tls_key: str | None,
) -> None:
    """Ask the appliance that runs FILE on this machine whether it is ready.

    The address is that of the section `metrics` in FILE, otherwise of `gateway`. With --url,
    nothing is read from FILE, which is faster. A certificate is verified with --url, and with
    --tls-ca.

    Exit codes: 0 ready (with --live: live), 1 not ready or no answer in time, 2 wrong usage, or
    FILE has errors or none of the sections.
    """
    if (file is None) == (url is None):
        raise click.UsageError("Give either FILE or --url.")
    tls = tls_of("tls", tls_ca, tls_cert, tls_key)
    if url is None:
        assert file is not None
        base, context = _configured(file), _context(tls, verified=tls.ca is not None)
    else:
        base, context = _checked(url), _context(tls, verified=True)
    path = probes.LIVE if live else probes.READY
    try:
        found = _asked(base, path, timeout, context)
    except _NoAnswer as error:
        if as_json:
            click.echo(json.dumps({"ok": False, "reason": "connection", "detail": str(error)}))
        else:
            click.echo(f"holdfast: {base}{path}: {error}", err=True)
        sys.exit(1)
    state = "live" if live else "ready"
    click.echo(json.dumps(found, indent=2) if as_json else _shown(found, state))
    sys.exit(0 if found["ok"] else 1)


def _configured(file: Path) -> str:
    """The URL of the service in a configuration. Exits with 2 if it has none."""
    from holdfast.cli.configuration import WRONG, show_problems
    from holdfast.config import ConfigError, load

    try:
        config = load(file)
    except ConfigError as error:
        show_problems(error)
        sys.exit(WRONG)
    for name in SERVICES:
        service = getattr(config, name)
        if service is None:
            continue
        if service.bind.port == 0:
            raise click.UsageError(f"{file}: {name}.bind has port 0: use --url.")
        scheme = "http" if service.tls is None else "https"
        return f"{scheme}://{joined(reachable(service.bind.host), service.bind.port)}"
    sections = " or ".join(f"`{name}`" for name in SERVICES)
    raise click.UsageError(f"{file} has no section {sections}, which answer probes.")


def _checked(url: str) -> str:
    """The scheme, host and port of a URL. Raises `click.BadParameter`."""
    parts = urlsplit(url)
    try:
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid = False
    if not valid or parts.path not in ("", "/") or parts.query or parts.fragment or parts.username:
        allowed = "allowed: http://HOST:PORT or https://HOST:PORT"
        raise click.BadParameter(f"found {url!r}, {allowed}.", param_hint="'--url'")
    return url.removesuffix("/")


def _context(tls: Tls, *, verified: bool) -> ssl.SSLContext:
    """The TLS of the connection. Raises `click.UsageError` for unusable files."""
    try:
        require_stored(tls.ca, tls.cert, tls.key)
        context = ssl.create_default_context(cafile=tls.ca)
        if tls.cert is not None:
            context.load_cert_chain(tls.cert, tls.key)
    except (OSError, ValueError) as error:
        raise click.UsageError(f"TLS: {error}.") from error
    if not verified:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    return context


def _asked(base: str, path: str, timeout: float, context: ssl.SSLContext) -> dict[str, Any]:
    """The answer to a probe. Raises `_NoAnswer`."""
    found: list[dict[str, Any] | _NoAnswer] = []
    # Names are looked up, and answers arrive, in steps that no timeout of a socket covers together.
    asking = threading.Thread(
        target=lambda: found.append(_outcome(base, path, timeout, context)), daemon=True
    )
    asking.start()
    asking.join(timeout)
    outcome = found[0] if found else _NoAnswer(f"no answer in {timeout:g} s")
    if isinstance(outcome, _NoAnswer):
        raise outcome
    return outcome


def _outcome(
    base: str, path: str, timeout: float, context: ssl.SSLContext
) -> dict[str, Any] | _NoAnswer:
    parts = urlsplit(base)
    connection = (
        http.client.HTTPSConnection(
            parts.hostname or "", parts.port, timeout=timeout, context=context
        )
        if parts.scheme == "https"
        else http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=timeout)
    )
    try:
        with contextlib.closing(connection):
            connection.request("GET", path)
            response = connection.getresponse()
            status, body = response.status, response.read(MAX_ANSWER)
    except TimeoutError:
        return _NoAnswer(f"no answer in {timeout:g} s")
    except (OSError, http.client.HTTPException) as error:
        return _NoAnswer(plain(str(error)) or type(error).__name__)
    try:
        answer = json.loads(body)
        checks = answer["checks"]
        [each["ok"] for each in checks.values()]
    except (ValueError, TypeError, KeyError, AttributeError):
        return _NoAnswer(f"status {status}, not the answer of an appliance to a probe")
    return {"ok": status == http.client.OK, "checks": checks}


def _shown(found: dict[str, Any], state: str) -> str:
    lines = [state if found["ok"] else f"not {state}"]
    rows = [
        (plain(name), "ok" if check["ok"] else "failed", plain(str(check.get("detail", ""))))
        for name, check in found["checks"].items()
    ]
    return "\n".join([*lines, *(f"  {line}" for line in table(("check", "", "detail"), rows))])
