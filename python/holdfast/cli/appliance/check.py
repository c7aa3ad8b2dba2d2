"""`holdfast check`: validates a configuration, and prints it with all defaults."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli import CommandWithSubcommands, complete_subcommand
from holdfast.cli.appliance.peer_rights import Peer, as_data, as_text
from holdfast.cli.configuration import load_or_exit
from holdfast.cli.options.option import json_option, option, schema_option
from holdfast.cli.terminal_text import print_json, problems_to_json
from holdfast.config import json_schema
from holdfast.net.addresses import parse_address

if TYPE_CHECKING:
    from holdfast.net.addresses import Address


def _address(text: str) -> Address:
    try:
        return parse_address(text)
    except ValueError:
        message = f"found {text!r}, allowed: an IP address, as in 10.0.0.7 or fd00::7"
        raise click.BadParameter(message) from None


SUBCOMMANDS = {
    "plan": ("devices.plan:plan", "Print the requests that read a device."),
}


@click.command(
    cls=CommandWithSubcommands,
    subcommands=SUBCOMMANDS,
    epilog="Example: holdfast check plant.yaml --as 10.0.0.7",
)
@click.argument("file", type=click.Path(path_type=Path), shell_complete=complete_subcommand)
@json_option
@option(
    "--as address",
    "ADDRESS",
    "Print what a peer with this IP address may do, instead of the configuration.",
    _address,
)
@option(
    "--role",
    "ROLE",
    "With --as: the role in the peer's certificate. Default: a certificate without a role.",
)
@schema_option("Print the JSON Schema of a configuration, for editors, and exit.", json_schema)
def check(file: Path, as_json: bool, address: Address | None, role: str | None) -> None:
    """Validate the configuration FILE without starting anything.

    Prints the effective configuration, with all defaults. With --as, prints what a peer may do, by
    listener and unit. If FILE is not valid, prints every problem with its line and exits with 2.

    For completion in editors with the YAML language server, write `holdfast check --schema` to a
    file, and start the configuration with the line
    `# yaml-language-server: $schema=holdfast.schema.json`.
    """
    if role is not None and address is None:
        raise click.UsageError("--role requires --as.")
    peer = None if address is None else Peer(address, role or "")
    config = load_or_exit(file, shows_warnings=not as_json)
    if not as_json:
        text = config.dump() if peer is None else f"{as_text(config, peer)}\n"
        click.echo(text, nl=False)
        return
    answer: dict[str, object] = {
        "ok": True,
        "target": str(file),
        "problems": [],
        "warnings": problems_to_json(config.warnings),
    }
    if peer is None:
        answer["config"] = config.effective()
    else:
        answer["peer"] = as_data(config, peer)
    print_json(answer, indent=2)
