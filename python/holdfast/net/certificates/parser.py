"""Parses certificates, keys and revocation lists, and encodes keys. Requires the extra `certs`."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias, TypeVar

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)

from holdfast.net.certificates.pem import (
    CERTIFICATE,
    LOCKED,
    REVOCATION_LIST,
    UnusableFile,
    blocks,
    content,
    is_key,
    is_locked,
    missing_block,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes

    from holdfast.net.certificates.pem import File

Part = TypeVar("Part")

PrivateKey: TypeAlias = ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey | rsa.RSAPrivateKey
"""The kinds of keys that TLS connections of Holdfast use."""

KEYS = "RSA, an EC key on P-256, P-384 or P-521, or Ed25519"

MALFORMED = (
    ValueError,
    TypeError,
    UnsupportedAlgorithm,
    x509.DuplicateExtension,
    x509.InvalidVersion,
    x509.UnsupportedGeneralNameType,
)
"""What `cryptography` raises for malformed files, for some parts only when they are used."""


def certificate(file: File, block: bytes) -> x509.Certificate:
    """Parses a block of a file. Raises `UnusableFile`."""
    return _parsed(file, "certificate", x509.load_pem_x509_certificate, block)


def revocation_list(file: File, block: bytes) -> x509.CertificateRevocationList:
    """Parses a block of a file. Raises `UnusableFile`."""
    return _parsed(file, "revocation list", x509.load_pem_x509_crl, block)


def _parsed(file: File, what: str, load: Callable[[bytes], Part], block: bytes) -> Part:
    try:
        return load(block)
    except MALFORMED as error:
        raise UnusableFile(file, f"a {what} can't be read: {error}") from error


def _blocks_of(file: File, what: str, is_kind: Callable[[str], bool]) -> list[bytes]:
    text = content(file)
    found = [block for label, block in blocks(text) if is_kind(label)]
    if not found:
        raise UnusableFile(file, missing_block(text, what))
    return found


def certificates(file: File) -> list[x509.Certificate]:
    """Returns all certificates of a file, at least one. Raises `UnusableFile`."""
    found = _blocks_of(file, "certificate", CERTIFICATE.__eq__)
    return [certificate(file, block) for block in found]


def revocation_lists(file: File) -> list[x509.CertificateRevocationList]:
    """Returns all revocation lists of a file, at least one. Raises `UnusableFile`."""
    found = _blocks_of(file, "revocation list (X509 CRL)", REVOCATION_LIST.__eq__)
    return [revocation_list(file, block) for block in found]


def public_key(certificate: x509.Certificate) -> CertificatePublicKeyTypes | None:
    """Returns the key of a certificate; `None` for a key of an unknown kind."""
    try:
        return certificate.public_key()
    except MALFORMED:
        return None


def key(file: File, secret: bytes | None = None) -> PrivateKey:
    """Returns the first key of a file; `secret` is its passphrase. Raises `UnusableFile`."""
    block = _blocks_of(file, "key", is_key)[0]
    if secret is None and is_locked(block):
        raise UnusableFile(file, LOCKED)
    if secret is not None and not is_locked(block):
        raise UnusableFile(file, "found a key without a passphrase, but a passphrase is given")
    try:
        private_key = load_pem_private_key(block, secret)
    except MALFORMED as error:
        wrong = "the passphrase is wrong, or the key can't be read"
        raise UnusableFile(file, wrong if secret else f"the key can't be read: {error}") from error
    if not isinstance(private_key, PrivateKey):
        raise UnusableFile(file, f"found a key of another kind, allowed: {KEYS}")
    return private_key


def key_pem(of: PrivateKey, passphrase: bytes | None = None) -> bytes:
    """Returns a key in PEM (PKCS#8), encrypted if there is a passphrase."""
    encryption = NoEncryption() if passphrase is None else BestAvailableEncryption(passphrase)
    return of.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption)
