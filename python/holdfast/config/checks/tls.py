"""Checks the TLS files of any section."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.checks.common import check_readable, given, refuse_repeats, until_invalid
from holdfast.config.text.messages import show_file
from holdfast.net.tls import alone

if TYPE_CHECKING:
    from holdfast.config.models.base import Model
    from holdfast.config.models.server_tls import HttpsConfig, ServerTlsConfig
    from holdfast.config.models.services import ClientTlsConfig
    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath

CLIENT_FILES = ("ca_file", "cert_file", "key_file")
SERVER_FILES = (*CLIENT_FILES, "key_passphrase_file", "client_ca_file", "crl_file")

SECRETS = ("password_file", "token_file", "credentials_file", "key_passphrase_file")


def check_files(path: KeyPath, settings: Model, keys: tuple[str, ...], report: Report) -> None:
    """Reports files that can't be read, of those of the keys that are given."""
    for key in given(settings, *keys):
        with until_invalid():
            where = (*path, key)
            shown = show_file(report.raw(where)) if key in SECRETS else None
            check_readable(where, getattr(settings, key), report, shown=shown)


def check_client_tls(path: KeyPath, tls: ClientTlsConfig | None, report: Report) -> None:
    """Reports problems with the files of a TLS client."""
    if tls is None:
        return
    keys = given(tls, *CLIENT_FILES)
    lonely = alone(cert="cert_file" in keys, key="key_file" in keys)
    if lonely is not None:
        written, missing = (f"{word}_file" for word in lonely)
        report.add_key((*path, written), f"found without {missing}, allowed: both or neither")
    check_files(path, tls, CLIENT_FILES, report)


def check_server_tls(path: KeyPath, tls: ServerTlsConfig | HttpsConfig, report: Report) -> None:
    """Reports files of a TLS or HTTPS server that can't be read. The model reports missing keys."""
    check_files(path, tls, SERVER_FILES, report)


def check_https(path: KeyPath, tls: HttpsConfig | None, report: Report) -> None:
    """Reports problems with the files of an HTTPS server."""
    if tls is None:
        return
    check_server_tls(path, tls, report)
    if not given(tls, "client_ca_file"):
        for key in given(tls, "crl_file", "roles"):
            report.add_key((*path, key), "found without client_ca_file, allowed: only with it")
    with until_invalid():
        refuse_repeats((*path, "roles"), tls.roles, report)
