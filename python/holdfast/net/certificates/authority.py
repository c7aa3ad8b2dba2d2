"""An authority of one's own: it issues certificates of servers and clients, and revokes them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from holdfast.net.certificates.expiry import now
from holdfast.net.certificates.parser import (
    MALFORMED,
    certificates,
    key,
    public_key,
    revocation_lists,
)
from holdfast.net.certificates.pem import UnusableFile
from holdfast.protocol import MAX_ROLE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.net.certificates.parser import PrivateKey
    from holdfast.net.certificates.pem import File

KeyKind: TypeAlias = Literal["p256", "p384", "p521", "rsa2048", "rsa3072", "rsa4096", "ed25519"]
KEY_KINDS: tuple[KeyKind, ...] = get_args(KeyKind)

ROLE = x509.ObjectIdentifier("1.3.6.1.4.1.50316.802.1")
"""The extension with the role of a client (MB-TCP-Security, R-21)."""

UTF8_STRING = 0x0C
"""The tag of a UTF8String in DER."""

MAX_NAME = 64
"""Characters of the longest common name (RFC 5280, ub-common-name)."""

MAX_DNS_NAME = 253

_LABEL = "[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_DNS_NAME = re.compile(rf"(\*\.)?{_LABEL}(\.{_LABEL})*", re.ASCII)

CLOCK_SKEW = timedelta(hours=1)
"""How long ago a certificate begins, because clocks of devices differ."""

CA_DAYS = 3650
LEAF_DAYS = 730
CRL_DAYS = 365

_SigningKey: TypeAlias = ec.EllipticCurvePublicKey | rsa.RSAPublicKey | ed25519.Ed25519PublicKey

_Curve: TypeAlias = type[ec.SECP256R1 | ec.SECP384R1 | ec.SECP521R1]
_CURVES: dict[str, _Curve] = {
    "p256": ec.SECP256R1,
    "p384": ec.SECP384R1,
    "p521": ec.SECP521R1,
}

_USAGES = (
    *("digital_signature", "content_commitment", "key_encipherment", "data_encipherment"),
    *("key_agreement", "key_cert_sign", "crl_sign", "encipher_only", "decipher_only"),
)


class Refused(ValueError):
    """The authority can't issue or revoke this certificate. The message says why."""


def new_key(kind: KeyKind) -> PrivateKey:
    """Generates a key."""
    if kind in _CURVES:
        return ec.generate_private_key(_CURVES[kind]())
    if kind == "ed25519":
        return ed25519.Ed25519PrivateKey.generate()
    return rsa.generate_private_key(65537, int(kind.removeprefix("rsa")))


def pem(*chain: x509.Certificate) -> bytes:
    """Returns certificates in PEM."""
    return b"".join(each.public_bytes(Encoding.PEM) for each in chain)


def list_pem(of: x509.CertificateRevocationList) -> bytes:
    """Returns a revocation list in PEM."""
    return of.public_bytes(Encoding.PEM)


@dataclass(frozen=True)
class Authority:
    """An authority: its certificate, those above it, and its key."""

    chain: tuple[x509.Certificate, ...]
    key: PrivateKey

    @staticmethod
    def create(name: str, kind: KeyKind = "p256", days: int = CA_DAYS) -> Authority:
        """Creates a self-signed authority. Raises `Refused`."""
        own, subject = new_key(kind), _subject(name)
        usage = _usage("key_cert_sign", "crl_sign")
        certificate = (
            _builder(subject, subject, own, now() + timedelta(days=days))
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .sign(own, _hash(own))
        )
        return Authority((certificate,), own)

    @staticmethod
    def load(ca_file: File, key_file: File, passphrase: bytes | None = None) -> Authority:
        """Reads an authority: its own certificate is the first. Raises `UnusableFile`."""
        chain, own = tuple(certificates(ca_file)), key(key_file, passphrase)
        if public_key(chain[0]) != own.public_key():
            raise UnusableFile(key_file, f"it is not the key of the certificate in {ca_file}")
        if not is_authority(chain[0]):
            raise UnusableFile(ca_file, "found no authority, allowed: a certificate with CA:TRUE")
        return Authority(chain, own)

    @property
    def certificate(self) -> x509.Certificate:
        """Its own certificate."""
        return self.chain[0]

    def issue_server(
        self, name: str, names: Sequence[x509.GeneralName], subject_key: PrivateKey, days: int
    ) -> x509.Certificate:
        """Issues the certificate of a server with these alternative names. Raises `Refused`."""
        if not names:
            raise Refused("a server needs at least one DNS name or IP address")
        builder = self._leaf(name, subject_key, days, ExtendedKeyUsageOID.SERVER_AUTH)
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        return builder.sign(self.key, _hash(self.key))

    def issue_client(
        self, name: str, role: str | None, subject_key: PrivateKey, days: int
    ) -> x509.Certificate:
        """Issues the certificate of a client, with or without a role. Raises `Refused`."""
        builder = self._leaf(name, subject_key, days, ExtendedKeyUsageOID.CLIENT_AUTH)
        if role is not None:
            extension = x509.UnrecognizedExtension(ROLE, role_der(role))
            builder = builder.add_extension(extension, critical=False)
        return builder.sign(self.key, _hash(self.key))

    def revocation_list(
        self,
        before: x509.CertificateRevocationList | None,
        revoked: Sequence[int] = (),
        days: int = CRL_DAYS,
    ) -> x509.CertificateRevocationList:
        """Returns a new list: the entries of the one before, and these serial numbers.

        Raises `Refused` if the list before is that of another authority, or the clock is wrong.
        """
        time, number = self._now(), 1
        builder = x509.CertificateRevocationListBuilder().issuer_name(self.certificate.subject)
        builder = builder.last_update(_begin(time)).next_update(time + timedelta(days=days))
        known: set[int] = set()
        if before is not None:
            if not is_list_of(before, self.certificate):
                raise Refused("the revocation list is that of another authority")
            number = _number(before) + 1
            for entry in before:
                known.add(entry.serial_number)
                builder = builder.add_revoked_certificate(entry)
        for serial in revoked:
            if serial not in known:
                known.add(serial)
                new = x509.RevokedCertificateBuilder().serial_number(serial)
                builder = builder.add_revoked_certificate(new.revocation_date(time).build())
        return (
            builder.add_extension(_issuer_id(self.certificate), critical=False)
            .add_extension(x509.CRLNumber(number), critical=False)
            .sign(self.key, _hash(self.key))
        )

    def _now(self) -> datetime:
        """The time. Raises `Refused` if the clock is before the beginning of the authority.

        What is made by such a clock has expired when it is right.
        """
        time, first = now(), self.certificate.not_valid_before_utc
        if time < first:
            raise Refused(
                f"the authority is not valid before {first:%Y-%m-%d %H:%M} UTC, and the clock says "
                f"{time:%Y-%m-%d %H:%M} UTC: correct it"
            )
        return time

    def _leaf(
        self, name: str, subject_key: PrivateKey, days: int, purpose: x509.ObjectIdentifier
    ) -> x509.CertificateBuilder:
        time, last = self._now(), self.certificate.not_valid_after_utc
        if last <= time:
            raise Refused(f"the authority expired on {last:%Y-%m-%d}: create a new one")
        ends = min(time + timedelta(days=days), last)
        builder = _builder(_subject(name), self.certificate.subject, subject_key, ends)
        return (
            builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_leaf_usage(subject_key), critical=True)
            .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
            .add_extension(_issuer_id(self.certificate), critical=False)
        )


def read_revocation_list(file: File) -> x509.CertificateRevocationList:
    """Reads the only revocation list of a file. Raises `UnusableFile`."""
    found = revocation_lists(file)
    if len(found) != 1:
        raise UnusableFile(file, f"found {len(found)} revocation lists, allowed: one")
    return found[0]


def alternative_name(text: str) -> x509.GeneralName:
    """Parses a DNS name or an IP address. Raises `Refused`."""
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        pass
    if len(text) > MAX_DNS_NAME or not _DNS_NAME.fullmatch(text):
        raise Refused(f"found {text!r}, allowed: a DNS name or an IP address")
    return x509.DNSName(text)


def is_authority(certificate: x509.Certificate) -> bool:
    """Returns whether a certificate can vouch for others."""
    try:
        return certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except (x509.ExtensionNotFound, *MALFORMED):
        return False


def has_signed(authority: x509.Certificate, certificate: x509.Certificate) -> bool:
    """Returns whether an authority has signed a certificate."""
    try:
        certificate.verify_directly_issued_by(authority)
    except (InvalidSignature, *MALFORMED):
        return False
    return True


def is_list_of(revocations: x509.CertificateRevocationList, authority: x509.Certificate) -> bool:
    """Returns whether an authority has signed a revocation list."""
    if revocations.issuer != authority.subject:
        return False
    return revocations.is_signature_valid(_signing_key(authority))


def _signing_key(authority: x509.Certificate) -> _SigningKey:
    public = authority.public_key()
    assert isinstance(public, _SigningKey), "the authority's own key is of these kinds"
    return public


def role_der(role: str) -> bytes:
    """Returns a role as the value of its extension, a UTF8String. Raises `Refused`."""
    text = _utf8(role, "role")
    if not text or len(text) > MAX_ROLE:
        raise Refused(f"found a role of {len(text)} bytes, allowed: 1 to {MAX_ROLE}")
    length = bytes([len(text)]) if len(text) < 0x80 else bytes([0x81, len(text)])
    return bytes([UTF8_STRING]) + length + text


def _utf8(text: str, what: str) -> bytes:
    """A text of a command line as UTF-8. Raises `Refused`."""
    try:
        return text.encode()
    except UnicodeEncodeError:
        raise Refused(f"found a {what} that is not text in UTF-8: {text!r}") from None


def _subject(name: str) -> x509.Name:
    if not 0 < len(name) <= MAX_NAME:
        raise Refused(f"found a name of {len(name)} characters, allowed: 1 to {MAX_NAME}")
    _utf8(name, "name")
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _builder(
    subject: x509.Name, issuer: x509.Name, subject_key: PrivateKey, ends: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(subject_key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_begin(now()))
        .not_valid_after(ends)
        .add_extension(
            x509.SubjectKeyIdentifier.from_public_key(subject_key.public_key()), critical=False
        )
    )


def _begin(time: datetime) -> datetime:
    """When something begins that is made now: not before 1970, which many programs can't read."""
    return max(time - CLOCK_SKEW, datetime(1970, 1, 1, tzinfo=UTC))


def _leaf_usage(subject_key: PrivateKey) -> x509.KeyUsage:
    # Cipher suites of old devices encrypt with an RSA key. Holdfast has none of them.
    if isinstance(subject_key, rsa.RSAPrivateKey):
        return _usage("digital_signature", "key_encipherment")
    return _usage("digital_signature")


def _usage(*allowed: str) -> x509.KeyUsage:
    return x509.KeyUsage(**{usage: usage in allowed for usage in _USAGES})


def _issuer_id(authority: x509.Certificate) -> x509.AuthorityKeyIdentifier:
    try:
        found = authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier)
    except x509.ExtensionNotFound:
        return x509.AuthorityKeyIdentifier.from_issuer_public_key(_signing_key(authority))
    return x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(found.value)


def _number(of: x509.CertificateRevocationList) -> int:
    try:
        return of.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
    except (x509.ExtensionNotFound, *MALFORMED):
        return 0


def _hash(of: PrivateKey) -> hashes.SHA256 | hashes.SHA384 | hashes.SHA512 | None:
    """Returns the hash that fits a signing key."""
    if isinstance(of, ed25519.Ed25519PrivateKey):
        return None
    size = of.curve.key_size if isinstance(of, ec.EllipticCurvePrivateKey) else 256
    if size > 384:
        return hashes.SHA512()
    return hashes.SHA384() if size > 256 else hashes.SHA256()
