"""Checks the TLS files of any section."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.files import check_readable
from holdfast.config.lenient import entries
from holdfast.config.unique import refuse_repeats
from holdfast.net.tls import alone

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

CLIENT_FILES = ("ca_file", "cert_file", "key_file")
SERVER_FILES = (
    "cert_file",
    "key_file",
    "key_passphrase_file",
    "ca_file",
    "client_ca_file",
    "crl_file",
)


def check_client_tls(path: KeyPath, tls: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports problems with the files of a TLS client."""
    lonely = alone(cert="cert_file" in tls, key="key_file" in tls)
    if lonely is not None:
        given, missing = (f"{word}_file" for word in lonely)
        message = f"found without {missing}, allowed: both or neither"
        report.add((*path, given), message, of_key=True)
    for key in CLIENT_FILES:
        check_readable((*path, key), tls.get(key), folder, report)


def check_server_tls(path: KeyPath, tls: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports files of a TLS or HTTPS server that can't be read. The model reports missing keys."""
    for key in SERVER_FILES:
        check_readable((*path, key), tls.get(key), folder, report)
    if "expired_crl" in tls and tls.get("crl_file") is None:
        report.doubt((*path, "expired_crl"), "has no effect without crl_file")


def check_https(path: KeyPath, tls: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports problems with the files of an HTTPS server."""
    check_server_tls(path, tls, folder, report)
    for key in ("crl_file", "roles"):
        if key in tls and "client_ca_file" not in tls:
            message = "found without client_ca_file, allowed: only with it"
            report.add((*path, key), message, of_key=True)
    refuse_repeats((*path, "roles"), entries(tls.get("roles")), report)
