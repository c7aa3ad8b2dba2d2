"""Options for addresses to listen on, and the clients that may connect."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from holdfast.cli.options.option import Command, option, parsed_by
from holdfast.client.async_transports import explained
from holdfast.config.values.ip_addresses import Bind, parse_bind, parse_source
from holdfast.net.addresses import LAST_PORT, address_in, joined

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.net.addresses import Network


def bind_option(port: int | None, help: str) -> Callable[[Command], Command]:
    """Adds `--bind`; `port` is the default one. The address or the port may be left out."""

    def parsed(ctx: click.Context, param: click.Parameter, texts: tuple[str, ...]) -> Bind | None:
        bind = None if port is None else parse_bind(f"127.0.0.1:{port}")
        for text in texts:
            try:
                bind = _bind(text, bind)
            except ValueError as error:
                raise click.BadParameter(str(error), ctx, param) from error
        return bind

    default = "" if port is None else f"  [default: 127.0.0.1:{port}]"
    # Several, as earlier versions had one option for the address and one for the port.
    return option("--bind", "ADDRESS:PORT", help + default, multiple=True, callback=parsed)


def _bind(text: str, before: Bind | None) -> Bind:
    """Parses ADDRESS:PORT, or one of them. Raises `ValueError`."""
    port = re.fullmatch(":?([0-9]{1,5})", text)
    if port is not None and int(port[1]) <= LAST_PORT:
        return parse_bind(joined(before.host if before else "127.0.0.1", int(port[1])))
    address = address_in(text)
    if address is not None and before is not None:
        return parse_bind(joined(str(address), before.port))
    return parse_bind(text)


def unbindable(bind: Bind, error: OSError) -> str:
    """Why a port can't be bound; the address is named once."""
    return f"can't listen on {bind}: {explained(error).rpartition(f'{bind}: ')[2]}"


_HELP = "Clients that may connect; repeatable. Default: this machine."
source_option = option("--source sources", "NETWORK", _HELP, parsed_by(parse_source), multiple=True)
"""Adds `--source`."""


def require_source(bind: Bind, sources: Sequence[Network]) -> None:
    """Raises `click.UsageError` for an address that others reach, without any source."""
    if not sources and not bind.address.is_loopback:
        raise click.UsageError(
            f"--bind {bind} is reachable from other machines: name the clients that may "
            "connect with --source NETWORK."
        )
