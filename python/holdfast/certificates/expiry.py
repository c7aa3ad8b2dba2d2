"""When certificates and revocation lists expire."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from holdfast.certificates.pem import MALFORMED, certificates, revocation_lists

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cryptography import x509

    from holdfast.certificates.pem import File

SOON = timedelta(days=30)
"""A certificate that expires within this time gives a warning."""


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

    def doubt(self, now: datetime) -> str | None:
        """Returns why it is not valid, or soon will not be; `None` if there is no doubt."""
        if self.ends <= now:
            return f"{self.what} expired on {self.ends:%Y-%m-%d}"
        if self.begins > now:
            return f"{self.what} is not valid before {self.begins:%Y-%m-%d %H:%M} UTC"
        if self.ends - now <= SOON:
            days = (self.ends - now).days
            left = (
                "in less than a day" if days < 1 else "in 1 day" if days == 1 else f"in {days} days"
            )
            return f"{self.what} expires {left}, on {self.ends:%Y-%m-%d}"
        return None


def of_certificates(file: File) -> list[Expiry]:
    """Returns the dates of all certificates of a file; none if the file can't be read.

    TLS decides whether a file is usable: some certificates that it takes can't be parsed here.
    """
    try:
        return [
            Expiry(
                f"the certificate of {subject(each)}",
                each.not_valid_before_utc,
                each.not_valid_after_utc,
            )
            for each in certificates(file)
        ]
    except MALFORMED:
        return []


def of_revocation_lists(file: File) -> list[Expiry]:
    """Returns the dates of all revocation lists of a file; none if it can't be read."""
    try:
        return list(_lists(file))
    except MALFORMED:
        return []


def _lists(file: File) -> Iterator[Expiry]:
    for each in revocation_lists(file):
        if each.next_update_utc is not None:
            what = f"the revocation list of {each.issuer.rfc4514_string()}"
            yield Expiry(what, each.last_update_utc, each.next_update_utc)


def subject(certificate: x509.Certificate) -> str:
    """Returns the subject of a certificate; its serial number if the subject is empty."""
    return certificate.subject.rfc4514_string() or f"serial {certificate.serial_number:x}"


def now() -> datetime:
    """Returns the time of this machine."""
    return datetime.now(UTC)
