"""The certificates of an HTTPS host, as a context of the `ssl` module."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
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


@dataclass(frozen=True)
class HttpsFiles:
    """The PEM files of an HTTPS host."""

    cert_file: Path
    """The certificate of the host, followed by its intermediate certificates."""
    key_file: Path
    key_passphrase_file: Path | None = None
    client_ca_file: Path | None = None
    """If given, clients need a certificate that these certificates vouch for."""
    crl_file: Path | None = None
    """If given, every authority above a client requires a list."""


class Https:
    """The TLS settings of a host, which can be reloaded while it serves."""

    def __init__(self, files: HttpsFiles) -> None:
        """Loads the files. Raises `UnusableFile`."""
        self._files = files
        self.context = _context(files)
        """The context for new connections. Open connections keep theirs."""

    def reload(self) -> None:
        """Loads the files again, for new connections. Thread-safe.

        Raises `UnusableFile` and changes nothing if a file can't be used.
        """
        self.adopt(Https(self._files))

    def adopt(self, other: Https) -> None:
        """Uses the files and certificates of another one for new connections. Thread-safe."""
        # A whole context: in the old one, certificates and authorities could only be added.
        self.context, self._files = other.context, other._files


def _context(files: HttpsFiles) -> ssl.SSLContext:
    """Returns a context for TLS 1.2 and 1.3. Raises `UnusableFile`."""
    check_own(files.cert_file, files.key_file, files.key_passphrase_file)
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    made.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_CIPHER_SERVER_PREFERENCE
    made.set_alpn_protocols(["http/1.1"])
    secret = files.key_passphrase_file
    # Without a password, OpenSSL would ask for one on the terminal.
    password = b"" if secret is None else passphrase(secret)
    try:
        made.load_cert_chain(files.cert_file, files.key_file, password)
    except (OSError, ValueError) as error:
        raise UnusableFile(files.cert_file, f"OpenSSL can't use it: {error}") from error
    if files.client_ca_file is not None:
        _require_clients(made, files.client_ca_file, files.crl_file)
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
