"""Reads certificates, keys and revocation lists from PEM files."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, TypeAlias

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa

from holdfast import bounded_files
from holdfast.bounded_files import MAX_CERTIFICATES

if TYPE_CHECKING:
    from os import PathLike

    from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes

    File: TypeAlias = str | PathLike[str]

PrivateKey: TypeAlias = ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey | rsa.RSAPrivateKey
"""The kinds of keys that TLS connections of Holdfast use."""

KEYS = "RSA, an EC key on P-256, P-384 or P-521, or Ed25519"

LOCKED = "the key is encrypted, and no passphrase is given"

_BLOCK = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----.*?-----END \1-----", re.DOTALL)


MALFORMED = (
    ValueError,
    TypeError,
    UnsupportedAlgorithm,
    x509.DuplicateExtension,
    x509.InvalidVersion,
    x509.UnsupportedGeneralNameType,
)
"""What `cryptography` raises for malformed files, for some parts only when they are used."""


class UnusableFile(ValueError):
    """An unusable file. The message names the file, what was found and what is allowed."""

    def __init__(self, file: File, flaw: str) -> None:
        super().__init__(f"{file}: {flaw}")

    @classmethod
    def of(cls, error: ValueError) -> UnusableFile:
        """Creates one from an error of the core, whose message has the same form."""
        return cls.__new__(cls, str(error))


def content(file: File) -> bytes:
    """Returns the content of a file. Raises `UnusableFile`."""
    try:
        return bounded_files.read(file, MAX_CERTIFICATES)
    except bounded_files.TooLarge as error:
        raise UnusableFile(file, f"more than {MAX_CERTIFICATES} bytes, allowed: PEM") from error
    except OSError as error:
        raise UnusableFile(file, error.strerror or str(error)) from error


def blocks(text: bytes) -> list[tuple[str, bytes]]:
    """Returns the PEM blocks of a text, each with its label."""
    return [(found[1].decode(), found[0]) for found in _BLOCK.finditer(text)]


def certificates(file: File) -> list[x509.Certificate]:
    """Returns all certificates of a file, at least one. Raises `UnusableFile`."""
    text = content(file)
    found = [block for label, block in blocks(text) if label == "CERTIFICATE"]
    if not found:
        raise UnusableFile(file, _missing(text, "certificate"))
    try:
        return [x509.load_pem_x509_certificate(block) for block in found]
    except MALFORMED as error:
        raise UnusableFile(file, f"a certificate can't be read: {error}") from error


def public_key(certificate: x509.Certificate) -> CertificatePublicKeyTypes | None:
    """Returns the key of a certificate; `None` for a key of an unknown kind."""
    try:
        return certificate.public_key()
    except MALFORMED:
        return None


def revocation_lists(file: File) -> list[x509.CertificateRevocationList]:
    """Returns all revocation lists of a file, at least one. Raises `UnusableFile`."""
    text = content(file)
    found = [block for label, block in blocks(text) if label == "X509 CRL"]
    if not found:
        raise UnusableFile(file, _missing(text, "revocation list (X509 CRL)"))
    try:
        return [x509.load_pem_x509_crl(block) for block in found]
    except MALFORMED as error:
        raise UnusableFile(file, f"a revocation list can't be read: {error}") from error


def passphrase(file: File) -> bytes:
    """Returns the passphrase in a file: its only line. Raises `UnusableFile`."""
    lines = content(file).splitlines()
    if len(lines) != 1 or not lines[0]:
        raise UnusableFile(file, f"found {len(lines)} lines, allowed: one line, the passphrase")
    return lines[0]


def is_locked(text: bytes) -> bool:
    """Returns whether a key in PEM is encrypted, in PKCS#8 or in the older form of OpenSSL."""
    return b"ENCRYPTED" in text


def key(file: File, secret: bytes | None = None) -> PrivateKey:
    """Returns the first key of a file; `secret` is its passphrase. Raises `UnusableFile`."""
    text = content(file)
    found = [block for label, block in blocks(text) if label.endswith("PRIVATE KEY")]
    if not found:
        raise UnusableFile(file, _missing(text, "key"))
    if secret is None and is_locked(found[0]):
        raise UnusableFile(file, LOCKED)
    if secret is not None and not is_locked(found[0]):
        raise UnusableFile(file, "found a key without a passphrase, but a passphrase is given")
    try:
        made = serialization.load_pem_private_key(found[0], secret)
    except MALFORMED as error:
        wrong = "the passphrase is wrong, or the key can't be read"
        raise UnusableFile(file, wrong if secret else f"the key can't be read: {error}") from error
    if not isinstance(made, PrivateKey):
        raise UnusableFile(file, f"found a key of another kind, allowed: {KEYS}")
    return made


def unlocked(file: File, passphrase_file: File | None) -> bytes | None:
    """Returns an encrypted key in PEM, without encryption; `None` for a key without a passphrase.

    Raises `UnusableFile`.
    """
    if passphrase_file is None:
        try:
            text = content(file)
        except UnusableFile:  # Whoever uses the file says so.
            return None
        if is_locked(text):
            raise UnusableFile(file, LOCKED)
        return None
    return key(file, passphrase(passphrase_file)).private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _missing(text: bytes, what: str) -> str:
    found = "DER" if text[:1] == b"\x30" else f"no {what}"
    return f"found {found}, allowed: a {what} in PEM"
