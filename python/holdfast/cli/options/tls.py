"""The command-line options for TLS files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from holdfast.cli.options.option import EXISTING_FILE, Command, file_option, option_group
from holdfast.net.tls import Tls, alone

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DEVICES = (
    "Trusted certificates for devices: of authorities, or of devices themselves.  [default: the "
    "system's authorities]"
)
FILE = click.Path(exists=True, dir_okay=False)


def tls_files(prefix: str, trusted: str, shown_to: str = "") -> list[Callable[[Command], Command]]:
    """The options `--PREFIX-ca`, `--PREFIX-cert` and `--PREFIX-key`."""
    texts = {"ca": trusted, "cert": f"Client certificate{shown_to}.", "key": "Its key."}
    return [file_option(f"--{prefix}-{name}", text, FILE) for name, text in texts.items()]


def tls_of(prefix: str, ca: str | None, cert: str | None, key: str | None) -> Tls:
    """The files of the options. Raises `click.UsageError`."""
    _require_both(prefix, cert, key)
    return Tls(ca, cert, key)


def _require_both(prefix: str, cert: object, key: object) -> None:
    lonely = alone(cert=cert is not None, key=key is not None)
    if lonely is not None:
        given, missing = lonely
        raise click.UsageError(f"--{prefix}-{given} requires --{prefix}-{missing}.")


def tls_options(prefix: str, into: str, *texts: str) -> Callable[[Command], Command]:
    """Adds the options of `tls_files`: an argument `into`, which is `Tls`."""
    return option_group(
        *tls_files(prefix, *texts),
        into=(into, lambda **files: tls_of(prefix, *files.values())),
    )


_HTTPS = {
    "cert cert_file": (
        "Serve HTTPS with this certificate, followed by its intermediate certificates."
    ),
    "key key_file": "Its key.",
    "passphrase-file key_passphrase_file": "File that contains the passphrase of the key.",
    "client-ca client_ca_file": "Require client certificates of these authorities.",
}
"""The options `--https-…` and their keys in a configuration."""


def _https_config(**given: Path | None) -> dict[str, Path] | None:
    """The files of the options, as in a configuration; `None` for HTTP.

    Raises `click.UsageError`.
    """
    _require_both("https", given["cert_file"], given["key_file"])
    files = {key: file for key, file in given.items() if file is not None}
    if files and "cert_file" not in files:
        raise click.UsageError(
            "--https-passphrase-file and --https-client-ca require --https-cert."
        )
    return files or None


https_options = option_group(
    *(file_option(f"--https-{name}", text, EXISTING_FILE) for name, text in _HTTPS.items()),
    into=("https", _https_config),
)
"""Adds `--https-cert`, `--https-key`, `--https-passphrase-file` and `--https-client-ca`."""
