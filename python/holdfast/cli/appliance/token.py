"""`holdfast token`: creates a secret for a client of REST or the gateway."""

from __future__ import annotations

import functools
import hashlib
import re
import secrets
import sys

import click

from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import flag, json_option, option
from holdfast.cli.terminal_text import print_json
from holdfast.config.dump import on_one_line
from holdfast.config.values.scalars import NAME_FORM, is_name

SECRET_BYTES = 32
MIN_CHARACTERS = 16
"""Secrets with fewer characters can be guessed."""

_ENTRY = """\
    - name: {name}
      sha256: "{digest}"
"""
_RIGHTS = """\
      memories: []          # names of memories
      areas: []             # coils, discrete_inputs, holding_registers, input_registers
      access:               # read-only or read-write
"""


@click.command(epilog="Example: holdfast token --name edge-gateway")
@option("--name", "NAME", "Name of the client.", default="edge-gateway")
@flag("--stdin", "Read the secret from standard input.")
@flag("--gateway", "Print an entry for gateway.tokens.")
@flag("--line", "Print a line for the token file of `holdfast gateway`.")
@json_option
def token(name: str, stdin: bool, gateway: bool, line: bool, as_json: bool) -> None:
    """Create a secret for a client of REST, and print its entry for the configuration.

    The secret is printed once and not stored: the configuration contains only its SHA-256. With
    --stdin, reads the secret as one line from standard input and does not print it. With --gateway,
    prints an entry for the section `gateway`. With --line, prints a line for the token file of
    `holdfast gateway`, and the secret on standard error.
    """
    if gateway + line + as_json > 1:
        raise click.UsageError("--gateway, --line and --json can't be used together.")
    if not is_name(name):
        raise click.BadParameter(f"found {name!r}, allowed: {NAME_FORM}", param_hint="'--name'")
    secret = _read() if stdin else secrets.token_urlsafe(SECRET_BYTES)
    digest = hashlib.sha256(secret.encode()).hexdigest()
    if as_json:
        shown = {} if stdin else {"token": secret}
        print_json({"ok": True, "name": name, **shown, "sha256": digest}, indent=2)
        return
    if line:
        if not stdin:
            click.echo(f"The secret, shown only once: {secret}", err=True)
        click.echo(f"{name} {digest}")
        return
    if not stdin:
        click.echo(f"The secret, shown only once: {secret}\n")
    click.echo(f"Add under {'gateway' if gateway else 'rest'}.tokens in the configuration:\n")
    entry = _ENTRY.format(name=on_one_line(name), digest=digest)
    click.echo(entry if gateway else entry + _RIGHTS, nl=False)


def _read() -> str:
    """Reads the secret from standard input, without the line end; a terminal does not show it."""
    if sys.stdin.isatty():
        ask = functools.partial(click.prompt, "Secret", hide_input=True, err=True)
        secret = str(ask(default="", show_default=False))
    else:
        secret = _decoded(sys.stdin.buffer.read())
    if not secret:
        fail("standard input has no secret", ExitCode.WRONG)
    if re.search(r"[\r\n]", secret):
        fail("standard input has more than one line, allowed: only the secret", ExitCode.WRONG)
    if not re.fullmatch(r"[!-~]+", secret):
        _warn("the secret has characters other than visible ASCII; many clients can't send them")
    if len(secret) < MIN_CHARACTERS:
        _warn(f"the secret has fewer than {MIN_CHARACTERS} characters and can be guessed")
    return secret


def _decoded(data: bytes) -> str:
    try:
        return re.sub(r"\r?\n\Z", "", data.decode())
    except UnicodeDecodeError:
        fail("standard input is not UTF-8", ExitCode.WRONG)


def _warn(message: str) -> None:
    click.echo(f"warning: {message}", err=True)
