"""Options for the connection to NATS."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli.options.option import EXISTING_FILE, file_option, option, option_group
from holdfast.cli.options.tls import tls_files, tls_of
from holdfast.config.values.scanner_settings import SERVER_PORT, parse_server
from holdfast.net.nats.connection import Servers

if TYPE_CHECKING:
    from holdfast.config.values.urls import Remote

DEFAULT_URL = f"nats://127.0.0.1:{SERVER_PORT}"
VARIABLE = "NATS_SERVERS"


def servers_of(**options: Any) -> Servers:
    """The servers and credentials. Raises a usage error for conflicting options."""
    if options["password_file"] is not None and options["user"] is None:
        raise click.UsageError("--password-file requires --user.")
    ways = [key for key in ("user", "token_file", "creds") if options[key] is not None]
    if len(ways) > 1:
        given = " and ".join(f"--{key.replace('_', '-')}" for key in ways)
        raise click.UsageError(f"{given} can't be used together.")
    urls = [url for each in options["nats"] for url in each]
    urls = urls or server_urls(os.environ.get(VARIABLE, ""))
    return Servers(
        tuple(urls) or (DEFAULT_URL,),
        options["user"],
        options["password_file"],
        options["token_file"],
        options["creds"],
        tls_of("tls", *(options[f"tls_{key}"] for key in ("ca", "cert", "key"))),
    )


def server_urls(text: str) -> list[str]:
    """Parses a comma-separated list of server URLs. Default scheme: nats://."""
    urls = []
    for part in filter(None, map(str.strip, text.split(","))):
        url = part if "://" in part else f"nats://{part}"
        try:
            without_secrets(url)
        except ValueError as error:
            raise click.BadParameter(f"{error}, as in {DEFAULT_URL}") from None
        urls.append(url)
    return urls


def without_secrets(url: str) -> Remote:
    """Parses a server URL, which may have a user and password before the host, and port 0."""
    scheme, mark, rest = url.removesuffix("/").partition("://")
    return parse_server(f"{scheme}{mark}{rest.rpartition('@')[2]}", least_port=0)


_NATS = f"NATS server; repeatable. [env: {VARIABLE}, comma-separated; default: {DEFAULT_URL}]"
nats_options = option_group(
    option("--nats", "URL", _NATS, server_urls, multiple=True),
    option("--user", "NAME", "User name for the NATS server."),
    file_option("--password-file", "File with the user's password.", EXISTING_FILE),
    file_option("--token-file", "File with a token for the NATS server.", EXISTING_FILE),
    file_option("--creds", "File with a user's JWT and seed.", EXISTING_FILE),
    *tls_files("tls", "Trusted authorities for the NATS server."),
    into=("servers", servers_of),
)
"""Adds `--nats`, the options for credentials, and those for TLS: the argument `servers`."""
