"""Describes certificates, keys and revocation lists, and what MB-TCP-Security requires of them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import dsa, ec, ed448, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, ExtensionOID

from holdfast.net.certificates.authority import ROLE, UTF8_STRING, has_signed, is_authority
from holdfast.net.certificates.expiry import Expiry, now, of_certificate
from holdfast.net.certificates.parser import (
    MALFORMED,
    certificate,
    key,
    public_key,
    revocation_list,
)
from holdfast.net.certificates.pem import (
    CERTIFICATE,
    REVOCATION_LIST,
    UnusableFile,
    blocks,
    content,
    is_key,
    is_locked,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.net.certificates.pem import File

MIN_RSA_BITS = 2048

_REQUIRED_OF_LISTS = {
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER: "authority key identifier",
    ExtensionOID.CRL_NUMBER: "CRL number",
}

_PURPOSES = {
    ExtendedKeyUsageOID.SERVER_AUTH: "server",
    ExtendedKeyUsageOID.CLIENT_AUTH: "client",
    ExtendedKeyUsageOID.ANY_EXTENDED_KEY_USAGE: "any",
}


@dataclass
class Described:
    """A certificate, a key or a revocation list of a file."""

    kind: str
    """`certificate`, `key` or `revocation list`."""
    fields: dict[str, Any] = field(default_factory=dict)
    flaws: list[str] = field(default_factory=list)
    """Requirements that it does not meet, each with its number if it is one of MB-TCP-Security."""
    advice: list[str] = field(default_factory=list)
    """Recommendations that it does not follow."""


def describe(file: File, passphrase: bytes | None = None) -> list[Described]:
    """Describes everything in a PEM file, in order. Raises `UnusableFile`."""
    try:
        return _described(file, passphrase)
    except UnusableFile:
        raise
    except MALFORMED as error:  # Parts of certificates are parsed when they are used.
        raise UnusableFile(file, f"it can't be read: {error}") from error


def _described(file: File, passphrase: bytes | None) -> list[Described]:
    text = content(file)
    found = blocks(text)
    chain = [certificate(file, block) for label, block in found if label == CERTIFICATE]
    described: list[Described] = []
    rest = iter(chain)
    for label, block in found:
        if label == CERTIFICATE:
            described.append(_of_certificate(next(rest)))
        elif label == REVOCATION_LIST:
            described.append(_of_list(revocation_list(file, block)))
        elif is_key(label):
            described.append(_of_key(file, block, passphrase, chain))
    if not described:
        form = "DER" if text[:1] == b"\x30" else "something else"
        raise UnusableFile(file, f"found {form}, allowed: certificates, keys or lists in PEM")
    if chain and not is_authority(chain[0]):
        _judge_chain(chain, next(each for each in described if each.kind == "certificate"))
    return described


def role_of(certificate: x509.Certificate) -> str | None:
    """Returns the role of a certificate, `None` without one.

    Raises `ValueError` if it is malformed.
    """
    try:
        value = certificate.extensions.get_extension_for_oid(ROLE).value
    except x509.ExtensionNotFound:
        return None
    assert isinstance(value, x509.UnrecognizedExtension)
    return _utf8_string(value.value)


def _utf8_string(der: bytes) -> str:
    """The text of a UTF8String in DER."""
    if der[:1] != bytes([UTF8_STRING]):
        raise ValueError("R-22: the role is not a UTF8String")
    size, start = der[1] if len(der) > 1 else 0, 2
    if size & 0x80:
        start = 2 + (size & 0x7F)
        size = int.from_bytes(der[2:start], "big")
    if len(der) != start + size:
        raise ValueError("R-22: the role is not valid DER")
    try:
        return der[start:].decode()
    except UnicodeDecodeError as error:
        raise ValueError("R-22: the role is not UTF-8") from error


def _of_certificate(certificate: x509.Certificate) -> Described:
    item = Described("certificate")
    item.fields = {
        "subject": certificate.subject.rfc4514_string(),
        "issuer": certificate.issuer.rfc4514_string(),
        "serial": serial_text(certificate.serial_number),
        "not_before": certificate.not_valid_before_utc.isoformat(),
        "not_after": certificate.not_valid_after_utc.isoformat(),
        "key": key_text(public_key(certificate)),
        "signature": _signature_text(_hash_of(certificate)),
        "sha256": certificate.fingerprint(hashes.SHA256()).hex(":"),
    }
    if certificate.version != x509.Version.v3:
        item.flaws.append("R-03: the certificate is not of X.509 version 3")
        return item
    try:
        extensions = certificate.extensions
    except x509.DuplicateExtension as error:
        role = "R-65: the role occurs twice"
        other = f"R-47: the extension {error.oid.dotted_string} occurs twice"
        item.flaws.append(role if error.oid == ROLE else other)
        return item
    except MALFORMED as error:
        item.flaws.append(f"R-47: the extensions can't be read: {error}")
        return item
    authority = is_authority(certificate)
    item.fields["authority"] = authority
    purposes = _purposes(extensions)
    item.fields["purpose"] = ["authority"] if authority else purposes
    names = _names(extensions)
    if names:
        item.fields["names"] = names
    _judge_dates(certificate, item)
    _judge_key(certificate, item)
    if not authority:
        _judge_role(certificate, extensions, purposes, item)
        if "server" in purposes and not names:
            item.flaws.append("RFC 9525: a server without a DNS name or IP address is refused")
    return item


def _judge_dates(certificate: x509.Certificate, item: Described) -> None:
    dates = of_certificate(certificate, "the certificate")
    warning = dates.warning(now())
    if warning is not None:
        valid = dates.is_valid(now())
        (item.advice if valid else item.flaws).append(warning if valid else f"R-47: {warning}")


def _judge_key(certificate: x509.Certificate, item: Described) -> None:
    public = public_key(certificate)
    if public is None:
        item.flaws.append("the key is of an unknown kind")
    if isinstance(public, rsa.RSAPublicKey) and public.key_size < MIN_RSA_BITS:
        item.flaws.append(f"the key has {public.key_size} bits, required: {MIN_RSA_BITS}")
    if isinstance(public, dsa.DSAPublicKey | ed448.Ed448PublicKey):
        item.flaws.append("no cipher suite of Modbus devices takes this kind of key")
    if isinstance(_hash_of(certificate), hashes.SHA1 | hashes.MD5):
        item.flaws.append("the certificate is signed with a broken hash, required: SHA-256 or more")
    elif isinstance(public, ed25519.Ed25519PublicKey) or (
        isinstance(public, ec.EllipticCurvePublicKey) and public.curve.name != "secp256r1"
    ):
        item.advice.append("R-61: devices need not support curves other than P-256")


def _judge_role(
    certificate: x509.Certificate,
    extensions: x509.Extensions,
    purposes: Sequence[str],
    item: Described,
) -> None:
    try:
        role = role_of(certificate)
    except ValueError as error:
        item.flaws.append(str(error))
        return
    if role is not None:
        item.fields["role"] = role
        if extensions.get_extension_for_oid(ROLE).critical:
            item.flaws.append("the role is critical, which most devices refuse")
    elif "client" in purposes or "any" in purposes:
        item.advice.append("R-20: a client's certificate should have a role")


def _judge_chain(chain: Sequence[x509.Certificate], item: Described) -> None:
    """The first certificate must come with all above it, the root included."""
    at, left = chain[0], list(chain[1:])
    if at.issuer == at.subject:
        item.advice.append("R-45: the certificate should be signed by an authority")
        return
    while at.issuer != at.subject:
        above = next((each for each in left if has_signed(each, at)), None)
        if above is None:
            issuer = at.issuer.rfc4514_string()
            item.flaws.append(f"R-46: the chain is incomplete: the file has no {issuer}")
            return
        left.remove(above)
        at = above


def _of_list(read: x509.CertificateRevocationList) -> Described:
    ends = read.next_update_utc
    item = Described("revocation list")
    item.fields = {
        "issuer": read.issuer.rfc4514_string(),
        "this_update": read.last_update_utc.isoformat(),
        "next_update": None if ends is None else ends.isoformat(),
        "revoked": [_revoked(entry) for entry in read],
    }
    lacks = _lacks(read)
    if lacks is not None:
        item.advice.append(f"the list {lacks}")
    if ends is not None:
        warning = Expiry("the list", read.last_update_utc, ends).warning(now())
        if warning is not None:
            (item.flaws if ends <= now() else item.advice).append(warning)
    return item


def _lacks(read: x509.CertificateRevocationList) -> str | None:
    """Returns which extensions a list lacks that RFC 5280, 5.2 requires; `None` if it has both."""
    present = {each.oid for each in read.extensions}
    missing = [name for oid, name in _REQUIRED_OF_LISTS.items() if oid not in present]
    if not missing:
        return None
    lacks = " and no ".join(missing)
    return f"has no {lacks} (RFC 5280, 5.2): Holdfast uses it, other programs may refuse it"


def _revoked(entry: x509.RevokedCertificate) -> dict[str, str]:
    try:
        reason = entry.extensions.get_extension_for_class(x509.CRLReason).value.reason.value
    except (x509.ExtensionNotFound, *MALFORMED):
        reason = "unspecified"
    return {
        "serial": serial_text(entry.serial_number),
        "date": entry.revocation_date_utc.isoformat(),
        "reason": reason,
    }


def _of_key(
    file: File, block: bytes, passphrase: bytes | None, chain: Sequence[x509.Certificate]
) -> Described:
    locked = is_locked(block)
    item = Described("key", {"encrypted": locked})
    if locked and passphrase is None:
        return item
    public = key(file, passphrase if locked else None).public_key()
    item.fields["key"] = key_text(public)
    spki = public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    item.fields["public_key_sha256"] = hashlib.sha256(spki).digest().hex(":")
    if chain:
        fits = public == public_key(chain[0])
        item.fields["fits_certificate"] = fits
        if not fits:
            item.flaws.append("it is not the key of the first certificate")
    return item


def _hash_of(certificate: x509.Certificate) -> hashes.HashAlgorithm | None:
    try:
        return certificate.signature_hash_algorithm
    except MALFORMED:
        return None


def serial_text(serial: int) -> str:
    """Returns a serial number as pairs of hexadecimal digits."""
    text = f"{abs(serial):x}"
    text = text if len(text) % 2 == 0 else f"0{text}"
    return ("-" if serial < 0 else "") + bytes.fromhex(text).hex(":")


def key_text(public: object) -> str:
    """Returns the kind of a key."""
    names = {"secp256r1": "P-256", "secp384r1": "P-384", "secp521r1": "P-521"}
    if isinstance(public, ec.EllipticCurvePublicKey):
        return names.get(public.curve.name, public.curve.name)
    if isinstance(public, rsa.RSAPublicKey):
        return f"RSA, {public.key_size} bits"
    return "unknown" if public is None else type(public).__name__.removesuffix("PublicKey")


def _signature_text(algorithm: hashes.HashAlgorithm | None) -> str:
    return "without a hash" if algorithm is None else algorithm.name.upper().replace("SHA", "SHA-")


def _purposes(extensions: x509.Extensions) -> list[str]:
    try:
        usages = extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return ["any"]
    return [_PURPOSES.get(usage, usage.dotted_string) for usage in usages]


def _names(extensions: x509.Extensions) -> list[str]:
    try:
        names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [str(each.value) for each in names if isinstance(each, x509.DNSName | x509.IPAddress)]
