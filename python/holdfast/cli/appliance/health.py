"""`holdfast health`: asks a running appliance whether it is ready, for scripts and containers."""

from __future__ import annotations

import contextlib
import http.client
import json
import ssl
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from holdfast.appliance.control import NotRunning, ask
from holdfast.appliance.health import SERVICES, probe_url
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.duration import Duration, timeout_option
from holdfast.cli.options.option import flag, json_option, option
from holdfast.cli.options.tls import tls_options
from holdfast.cli.terminal_text import plain, print_json, show_problems, table
from holdfast.net.http import health as probes
from holdfast.net.secure_channel import failure_text
from holdfast.runtime.bounded_files import require_stored

if TYPE_CHECKING:
    from holdfast.net.tls import Tls

MAX_ANSWER_BYTES = 1 << 20
"""The most bytes of an answer that are read."""


class _NoAnswer(Exception):
    """The appliance has not answered a probe."""

    @classmethod
    def within(cls, timeout: float) -> _NoAnswer:
        """The time is over."""
        return cls(f"no answer in {timeout:g} s")


@click.command(epilog="Example: holdfast health plant.yaml")
@click.argument("file", required=False, type=click.Path(path_type=Path))
@option("--url", "URL", "Ask here, as in http://127.0.0.1:9464, without FILE.")
@flag("--live", "Ask whether it is live, instead of whether it is ready.")
@timeout_option("4", "Time for the whole answer.", Duration(0.1, 3600))
@json_option
@tls_options("tls", "tls", "Trusted authorities of the service.")
def health(
    file: Path | None, url: str | None, live: bool, timeout: float, as_json: bool, tls: Tls
) -> None:
    """Ask the appliance that runs FILE on this machine whether it is ready.

    The address is that of the section `metrics`, otherwise of `gateway`: as the running appliance
    has it, if it is one of this user, otherwise as FILE has it. A certificate is verified only with
    --url or --tls-ca.

    Exit codes: 0 ready (with --live: live), 1 not ready or no valid answer, 2 wrong usage, neither
    section, or FILE has errors and no appliance of this user runs it.
    """
    if (file is None) == (url is None):
        raise click.UsageError("Give either FILE or --url.")
    hint, until = "", time.monotonic() + timeout
    if url is None:
        assert file is not None
        found = _url_of_running(file, timeout)
        if found is None:  # Reading the configuration is no part of the answer.
            found, until = _url_from_config(file), time.monotonic() + timeout
        base, hint = found
        context = _context(tls, verified=tls.ca is not None)
    else:
        base, context = _checked_url(url), _context(tls, verified=True)
    path = probes.LIVE if live else probes.READY
    try:
        probe = _probe(base, path, timeout, until, context)
    except _NoAnswer as error:
        fail(f"{base}{path}: {error}{hint}", reason="connection", target=f"{base}{path}")
    state = "live" if live else "ready"
    if as_json:
        failed = [name for name, check in probe["checks"].items() if not check["ok"]]
        failure = {} if probe["ok"] else {"reason": f"not_{state}", "detail": ", ".join(failed)}
        answer = {"ok": probe["ok"], "target": f"{base}{path}", **failure}
        answer["checks"] = probe["checks"]
        print_json(answer, indent=2)
    else:
        click.echo(_shown(probe, state))
    sys.exit(ExitCode.SUCCESS if probe["ok"] else ExitCode.FAILED)


def _url_of_running(file: Path, timeout: float) -> tuple[str, str] | None:
    """The URL of the service of the appliance that runs a configuration, which may have changed
    since, and why it may refuse this machine. `None` if no appliance says so.

    Exits with 1 if one does not answer in time, and with 2 if it has no such service.
    """
    until = time.monotonic() + timeout
    try:
        answer = ask(file, "probe_url", within_s=timeout, ping_s=timeout)
    except NotRunning:
        if time.monotonic() < until:
            return None
        fail(f"{file}: {_NoAnswer.within(timeout)}", reason="connection", target=file)
    if "found" not in answer:  # An appliance of an earlier version.
        return None
    if answer["found"] is None:
        raise _without_service(f"The appliance that runs {file}")
    base, hint = map(plain, answer["found"])
    return base, hint


def _url_from_config(file: Path) -> tuple[str, str]:
    """The URL of the service in a configuration, and why it may refuse this machine.

    Exits with 2 if there is none.
    """
    from holdfast.config import ConfigError, load

    try:
        config = load(file)
    except ConfigError as error:
        show_problems(error)
        sys.exit(ExitCode.WRONG)
    for name in SERVICES:
        service = getattr(config, name)
        if service is None:
            continue
        if service.bind.port == 0:
            raise click.UsageError(f"{file}: {name}.bind has port 0: use --url.")
        return probe_url(name, service, service.bind.port)
    raise _without_service(str(file))


def _without_service(who: str) -> click.UsageError:
    sections = " or ".join(f"`{name}`" for name in SERVICES)
    return click.UsageError(f"{who} has no section {sections}, which answer probes.")


def _checked_url(url: str) -> str:
    """The URL without a slash at its end.

    Raises `click.BadParameter` unless it has only scheme, host and port.
    """
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid, parts = False, urlsplit("")
    if not valid or parts.path not in ("", "/") or parts.query or parts.fragment or parts.username:
        allowed = "allowed: http://HOST[:PORT] or https://HOST[:PORT]"
        raise click.BadParameter(f"found {url!r}, {allowed}.", param_hint="'--url'")
    return url.removesuffix("/")


def _context(tls: Tls, *, verified: bool) -> ssl.SSLContext:
    """The TLS of the connection. Raises `click.UsageError` for unusable files."""
    try:
        require_stored(tls.ca, tls.cert, tls.key)
        context = ssl.create_default_context(cafile=tls.ca)
        if tls.cert is not None:
            context.load_cert_chain(tls.cert, tls.key, password="")  # Never ask on the terminal.
    except (OSError, ValueError) as error:
        raise click.UsageError(f"TLS: {error}") from error
    if not verified:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    return context


def _probe(
    base: str, path: str, timeout: float, until: float, context: ssl.SSLContext
) -> dict[str, Any]:
    """The answer to a probe. Raises `_NoAnswer`, also when the timeout is over, at `until`."""
    found: list[dict[str, Any] | _NoAnswer] = []
    # A socket timeout limits each step; nothing limits the name lookup and all steps together.
    asking = threading.Thread(
        target=lambda: found.append(_response(base, path, timeout, context)), daemon=True
    )
    asking.start()
    asking.join(max(0.0, until - time.monotonic()))
    outcome = found[0] if found else _NoAnswer.within(timeout)
    if isinstance(outcome, _NoAnswer):
        raise outcome
    return outcome


def _response(
    base: str, path: str, timeout: float, context: ssl.SSLContext
) -> dict[str, Any] | _NoAnswer:
    parts = urlsplit(base)
    host, port = parts.hostname or "", parts.port
    try:
        connection = (
            http.client.HTTPSConnection(host, port, timeout=timeout, context=context)
            if parts.scheme == "https"
            else http.client.HTTPConnection(host, port, timeout=timeout)
        )
        with contextlib.closing(connection):
            connection.request("GET", path)
            response = connection.getresponse()
            status, body = response.status, response.read(MAX_ANSWER_BYTES)
    except TimeoutError:
        return _NoAnswer.within(timeout)
    # `ValueError`: the host is not a valid name.
    except (OSError, http.client.HTTPException, ValueError) as error:
        return _NoAnswer(plain(failure_text(error)))
    try:
        answer = json.loads(body)
        is_well, checks = answer["ok"] is True, answer["checks"]
        [each["ok"] for each in checks.values()]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return _NoAnswer(f"status {status}, not the answer of an appliance to a probe")
    return {"ok": status == http.client.OK and is_well, "checks": checks}


def _shown(found: dict[str, Any], state: str) -> str:
    lines = [state if found["ok"] else f"not {state}"]
    rows = [
        (plain(name), "ok" if check["ok"] else "failed", plain(str(check.get("detail", ""))))
        for name, check in found["checks"].items()
    ]
    return "\n".join([*lines, *(f"  {line}" for line in table(("check", "", "detail"), rows))])
