"""The command-line options for TLS files."""

from __future__ import annotations

from pathlib import Path
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


def https_options(command: Command) -> Command:
    """Adds `--https-cert`, `--https-key`, `--https-passphrase-file` and `--https-client-ca`."""
    file = click.Path(exists=True, dir_okay=False, path_type=Path)
    told = {
        "cert": "Serve HTTPS with this certificate, followed by its intermediate certificates.",
        "key": "Its key.",
        "passphrase-file": "File that contains the passphrase of the key.",
        "client-ca": "Require client certificates of these authorities.",
    }
    for name, text in reversed(told.items()):
        command = click.option(f"--https-{name}", type=file, metavar="FILE", help=text)(command)
    return command


def https_config(
    cert: Path | None, key: Path | None, passphrase_file: Path | None, client_ca: Path | None
) -> dict[str, Path] | None:
    """The files of the options, as in a configuration; `None` for HTTP.

    Raises `click.UsageError`.
    """
    lonely = alone(cert=cert is not None, key=key is not None)
    if lonely is not None:
        given, missing = lonely
        raise click.UsageError(f"--https-{given} requires --https-{missing}.")
    if cert is None or key is None:
        if passphrase_file is not None or client_ca is not None:
            raise click.UsageError(
                "--https-passphrase-file and --https-client-ca require --https-cert."
            )
        return None
    named = {
        "cert_file": cert,
        "key_file": key,
        "key_passphrase_file": passphrase_file,
        "client_ca_file": client_ca,
    }
    return {key: file for key, file in named.items() if file is not None}
