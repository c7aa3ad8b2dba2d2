"""The certificate of a server, and the key that belongs to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from holdfast.bounded_files import require_stored
from holdfast.certificates.pem import (
    MALFORMED,
    UnusableFile,
    certificates,
    key,
    passphrase,
    public_key,
    unlocked,
)

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.types import PublicKeyTypes

    from holdfast.certificates.pem import File


def check_own(cert_file: File, key_file: File, passphrase_file: File | None = None) -> None:
    """Checks that the files are readable and belong together. Raises `UnusableFile`."""
    own = public_key(certificates(cert_file)[0])
    secret = None if passphrase_file is None else passphrase(passphrase_file)
    if own is None:
        raise UnusableFile(cert_file, "the certificate has a key of an unknown kind")
    if _spki(own) != _spki(key(key_file, secret).public_key()):
        raise UnusableFile(key_file, f"it is not the key of the certificate in {cert_file}")


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


def _spki(public: PublicKeyTypes) -> bytes:
    return public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
