"""`holdfast check`: validates a configuration, and prints it with all defaults."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli.configuration import WRONG, load_or_exit, load_whole
from holdfast.cli.peer_rights import Peer, as_data, as_text
from holdfast.config import ConfigError
from holdfast.net.addresses import parse_address

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config import Problem
    from holdfast.net.addresses import Address


def _address(
    _context: click.Context, _parameter: click.Parameter, value: str | None
) -> Address | None:
    try:
        return None if value is None else parse_address(value)
    except ValueError:
        message = f"found {value!r}, allowed: an IP address, as in 10.0.0.7 or fd00::7"
        raise click.BadParameter(message) from None


@click.command(epilog="Example: holdfast check plant.yaml --as 10.0.0.7")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs.")
@click.option(
    "--as",
    "address",
    metavar="ADDRESS",
    callback=_address,
    help="Print what a peer with this IP address may do, instead of the configuration.",
)
@click.option(
    "--role",
    metavar="ROLE",
    help="With --as: the role in the peer's certificate. Default: a certificate without a role.",
)
def check(file: Path, as_json: bool, address: Address | None, role: str | None) -> None:
    """Validate the configuration FILE without starting anything.

    Prints the effective configuration, with all defaults. With --as, prints what a peer may do, by
    listener and unit. If FILE is not valid, prints every problem with its line and exits with 2.
    """
    if role is not None and address is None:
        raise click.UsageError("--role requires --as.")
    peer = None if address is None else Peer(address, role or "")
    if not as_json:
        config = load_or_exit(file)
        text = config.dump() if peer is None else f"{as_text(config, peer)}\n"
        click.echo(text, nl=False)
        return
    try:
        config = load_whole(file)
    except ConfigError as error:
        click.echo(json.dumps({"ok": False, "problems": _plain(error.problems)}, indent=2))
        sys.exit(WRONG)
    answer: dict[str, object] = {
        "ok": True,
        "problems": [],
        "warnings": _plain(config.warnings),
    }
    if peer is None:
        answer["config"] = config.effective()
    else:
        answer["peer"] = as_data(config, peer)
    click.echo(json.dumps(answer, indent=2))


def _plain(problems: Iterable[Problem]) -> list[dict[str, object]]:
    return [dataclasses.asdict(problem) for problem in problems]
