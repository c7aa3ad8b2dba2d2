"""What the files of TLS must keep together, wherever a section names some."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.files import check_readable
from holdfast.net.tls import alone

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

CLIENT_FILES = ("ca_file", "cert_file", "key_file")
SERVER_FILES = ("cert_file", "key_file", "ca_file", "crl_file")


def check_client_tls(path: KeyPath, tls: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports what is wrong with the files for those that are connected to."""
    lonely = alone(cert="cert_file" in tls, key="key_file" in tls)
    if lonely is not None:
        given, missing = (f"{word}_file" for word in lonely)
        message = f"found without {missing}, allowed: both or none"
        report.add((*path, given), message, of_key=True)
    for key in CLIENT_FILES:
        check_readable((*path, key), tls.get(key), folder, report)


def check_server_tls(path: KeyPath, tls: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports which files of a server can't be read; that it needs them is the model's to say."""
    for key in SERVER_FILES:
        check_readable((*path, key), tls.get(key), folder, report)
