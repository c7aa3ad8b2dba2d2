"""Checks rules between keys of NATS servers: credentials and certificates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.files import check_readable
from holdfast.config.lenient import entries, mapping, parsed
from holdfast.config.scanning import check_dialect, parse_server
from holdfast.config.tls_checks import check_client_tls
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

_IDENTITIES = ("username", "token_file", "credentials_file")
"""Keys that authenticate a client at the NATS server; only one of them is allowed."""


def check_nats(path: KeyPath, nats: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports what is wrong with the servers of a section; files are relative to `folder`."""
    if "password_file" in nats and "username" not in nats:
        message = "found without username, allowed: both or neither"
        report.add((*path, "password_file"), message, of_key=True)
    for key in ("password_file", "token_file", "credentials_file"):
        check_readable((*path, key), nats.get(key), folder, report)
    first, *others = [key for key in _IDENTITIES if key in nats] or [""]
    for key in others:
        message = f"found together with {first}, allowed: only one of {listing(_IDENTITIES)}"
        report.add((*path, key), message, of_key=True)
    servers = [parsed(parse_server, url) for url in entries(nats.get("servers"))]
    if "tls" in nats and servers and all(each and each.scheme == "nats" for each in servers):
        message = "found with servers that begin with nats://, allowed: only with tls://"
        report.add((*path, "tls"), message, of_key=True)
    check_client_tls((*path, "tls"), mapping(nats.get("tls")), folder, report)
    for key, found, allowed in (
        ("dialect", "tentacle-next", "tentacle"),
        ("keep_subscriptions", False, "true"),
    ):
        if "fleet" in nats and nats.get(key) == found:
            shown = str(found).lower() if found is False else found
            report.add((*path, key), f"found {shown} together with fleet, allowed: {allowed}")
    if nats.get("dialect") == "tentacle-next" and isinstance(nats.get("prefix"), str):
        try:
            check_dialect("tentacle-next", nats["prefix"])
        except ValueError as error:
            report.add((*path, "prefix"), str(error))
