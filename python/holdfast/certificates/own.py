"""The certificate of a server, and the key that belongs to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from holdfast.bounded_files import require_stored
from holdfast.certificates.pem import (
    MALFORMED,
    UnusableFile,
    certificates,
    unlocked,
)

if TYPE_CHECKING:
    from holdfast.certificates.pem import File


def key_for_core(
    key_file: File, passphrase_file: File | None, *others: File | None
) -> bytes | None:
    """Returns the key of a server if it is encrypted, without encryption; otherwise `None`.

    The core reads the files itself, these and `others`: raises `UnusableFile` for one that could
    block it.
    """
    try:
        require_stored(key_file, *others)
    except OSError as error:
        raise UnusableFile(error.filename, error.strerror or str(error)) from error
    return unlocked(key_file, passphrase_file)


def own_der(cert_file: File) -> bytes:
    """Returns the first certificate of a file in DER. Raises `UnusableFile`."""
    return certificates(cert_file)[0].public_bytes(Encoding.DER)


def nameless(cert_file: File) -> str | None:
    """Returns why no client can match the certificate with a name or an address, or `None`."""
    try:
        own = certificates(cert_file)[0]
        names = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        found = "no subjectAltName"
    except MALFORMED:
        return None
    else:
        if any(isinstance(each, x509.DNSName | x509.IPAddress) for each in names):
            return None
        found = "a subjectAltName without a DNS name or an IP address"
    return f"found {found}: clients ignore the common name, so they refuse this certificate"
