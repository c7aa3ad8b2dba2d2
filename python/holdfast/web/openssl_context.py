"""The certificates of an HTTPS host, as a context of the `ssl` module."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING

from holdfast.certificates.own import check_own
from holdfast.certificates.pem import (
    UnusableFile,
    blocks,
    certificates,
    content,
    passphrase,
    revocation_lists,
)

if TYPE_CHECKING:
    from pathlib import Path


def openssl_context(
    cert_file: Path,
    key_file: Path,
    secret: Path | None,
    client_ca_file: Path | None,
    crl_file: Path | None,
) -> ssl.SSLContext:
    """Returns a context for TLS 1.2 and 1.3. Raises `UnusableFile`."""
    check_own(cert_file, key_file, secret)
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    made.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_CIPHER_SERVER_PREFERENCE
    made.set_alpn_protocols(["http/1.1"])
    # Without a password, OpenSSL would ask for one on the terminal.
    password = b"" if secret is None else passphrase(secret)
    try:
        made.load_cert_chain(cert_file, key_file, password)
    except (OSError, ValueError) as error:
        raise UnusableFile(cert_file, f"OpenSSL can't use it: {error}") from error
    if client_ca_file is not None:
        _require_clients(made, client_ca_file, crl_file)
    return made


def _require_clients(made: ssl.SSLContext, ca_file: Path, crl_file: Path | None) -> None:
    """Makes certificates of clients mandatory."""
    certificates(ca_file)
    made.verify_mode = ssl.CERT_REQUIRED
    # A listed authority needs no authority above it.
    made.verify_flags |= ssl.VerifyFlags.VERIFY_X509_PARTIAL_CHAIN
    _load(made, ca_file)
    if crl_file is not None:
        revocation_lists(crl_file)
        if any(label != "X509 CRL" for label, _ in blocks(content(crl_file))):
            raise UnusableFile(crl_file, "found something else, allowed: revocation lists alone")
        made.verify_flags |= ssl.VerifyFlags.VERIFY_CRL_CHECK_CHAIN
        _load(made, crl_file)


def _load(made: ssl.SSLContext, file: Path) -> None:
    try:
        made.load_verify_locations(file)
    except (OSError, ValueError) as error:
        raise UnusableFile(file, f"OpenSSL can't use it: {error}") from error
