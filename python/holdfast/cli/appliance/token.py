"""`holdfast token`: creates a secret for a client of REST or the gateway."""

from __future__ import annotations

import hashlib
import secrets

import click

from holdfast.cli.options.option import flag, json_option, option
from holdfast.cli.terminal_text import print_json
from holdfast.config.dump import on_one_line
from holdfast.config.values.scalars import TOKEN_NAME_FORM, is_token_name

SECRET_BYTES = 32

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
@flag("--gateway", "Print an entry for gateway.tokens.")
@flag("--line", "Print a line for the token file of `holdfast gateway`.")
@json_option
def token(name: str, gateway: bool, line: bool, as_json: bool) -> None:
    """Create a secret for a client of REST, and print its entry for the configuration.

    The secret is printed once and not stored: the configuration contains only its SHA-256. With
    --gateway, prints an entry for the section `gateway`. With --line, prints a line for the token
    file of `holdfast gateway`, and the secret on standard error.
    """
    if gateway + line + as_json > 1:
        raise click.UsageError("--gateway, --line and --json can't be used together.")
    if not is_token_name(name):
        raise click.BadParameter(
            f"found {name!r}, allowed: {TOKEN_NAME_FORM}", param_hint="'--name'"
        )
    secret = secrets.token_urlsafe(SECRET_BYTES)
    digest = hashlib.sha256(secret.encode()).hexdigest()
    if as_json:
        print_json({"ok": True, "name": name, "token": secret, "sha256": digest}, indent=2)
        return
    if line:
        click.echo(f"The secret, shown only once: {secret}", err=True)
        click.echo(f"{name} {digest}")
        return
    click.echo(f"The secret, shown only once: {secret}\n")
    click.echo(f"Add under {'gateway' if gateway else 'rest'}.tokens in the configuration:\n")
    entry = _ENTRY.format(name=on_one_line(name), digest=digest)
    click.echo(entry if gateway else entry + _RIGHTS, nl=False)
