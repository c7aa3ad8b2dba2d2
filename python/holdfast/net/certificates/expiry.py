"""When certificates and revocation lists expire."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from cryptography import x509

from holdfast.net.certificates import EXPIRY_NOTICE
from holdfast.net.certificates.parser import MALFORMED, certificates, revocation_lists
from holdfast.runtime.text import counted

if TYPE_CHECKING:
    from holdfast.net.certificates.pem import File


@dataclass(frozen=True)
class Expiry:
    """The dates of a certificate or a revocation list."""

    what: str
    """The certificate in a sentence, by its subject."""
    begins: datetime
    ends: datetime

    def is_valid(self, now: datetime) -> bool:
        """Whether it is valid now."""
        return self.begins <= now < self.ends

    def warning(self, now: datetime) -> str | None:
        """Returns why it is not valid, or soon will not be; `None` if it is and stays valid."""
        if self.ends <= now:
            return f"{self.what} expired on {self.ends:%Y-%m-%d}"
        if self.begins > now:
            return f"{self.what} is not valid before {self.begins:%Y-%m-%d %H:%M} UTC"
        if self.ends - now <= EXPIRY_NOTICE:
            days = (self.ends - now).days
            left = "less than a day" if days < 1 else counted(days, "day")
            return f"{self.what} expires in {left}, on {self.ends:%Y-%m-%d}"
        return None


def of_certificates(file: File) -> list[Expiry]:
    """Returns the dates of all certificates of a file; none if the file can't be read.

    TLS decides whether a file is usable: some certificates that it takes can't be parsed here.
    """
    try:
        found = certificates(file)
        return [of_certificate(each, f"the certificate of {subject(each)}") for each in found]
    except MALFORMED:
        return []


def of_certificate(certificate: x509.Certificate, what: str) -> Expiry:
    """Returns the dates of a certificate."""
    return Expiry(what, certificate.not_valid_before_utc, certificate.not_valid_after_utc)


def of_revocation_lists(file: File) -> list[Expiry]:
    """Returns the dates of all revocation lists of a file; none if it can't be read."""
    try:
        return [
            Expiry(
                f"the revocation list of {each.issuer.rfc4514_string()}", each.last_update_utc, ends
            )
            for each in revocation_lists(file)
            if (ends := each.next_update_utc) is not None
        ]
    except MALFORMED:
        return []


def missing_name_warning(cert_file: File) -> str | None:
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


def subject(certificate: x509.Certificate) -> str:
    """Returns the subject of a certificate; its serial number if the subject is empty."""
    return certificate.subject.rfc4514_string() or f"serial {certificate.serial_number:x}"


def now() -> datetime:
    """Returns the time of this machine."""
    return datetime.now(UTC)
