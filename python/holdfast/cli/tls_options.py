"""The command-line options for TLS files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import click

from holdfast.net.tls import Tls, alone

if TYPE_CHECKING:
    from collections.abc import Callable

Command = TypeVar("Command", bound="Callable[..., Any]")

DEVICES = (
    "Trusted certificates for devices: of authorities, or of devices themselves.  [default: the "
    "system's authorities]"
)
FILE = click.Path(exists=True, dir_okay=False)


def tls_options(prefix: str, trusted: str, shown_to: str = "") -> Callable[[Command], Command]:
    """Adds `--PREFIX-ca`, `--PREFIX-cert` and `--PREFIX-key`."""

    def added(command: Command) -> Command:
        ca = click.option(f"--{prefix}-ca", type=FILE, metavar="FILE", help=trusted)
        cert = click.option(
            f"--{prefix}-cert", type=FILE, metavar="FILE", help=f"Client certificate{shown_to}."
        )
        key = click.option(f"--{prefix}-key", type=FILE, metavar="FILE", help="Its key.")
        return ca(cert(key(command)))

    return added


def tls_of(prefix: str, ca: str | None, cert: str | None, key: str | None) -> Tls:
    """The files of the options. Raises `click.UsageError`."""
    lonely = alone(cert=cert is not None, key=key is not None)
    if lonely is not None:
        given, missing = lonely
        raise click.UsageError(f"--{prefix}-{given} requires --{prefix}-{missing}.")
    return Tls(ca, cert, key)
