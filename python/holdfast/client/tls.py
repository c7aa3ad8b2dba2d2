"""TLS in asyncio: the rules of the native core, and its words for what goes wrong."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.client.target import Tls

CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Of TLS 1.2; those of the native core."""

UNKNOWN = "the issuer of the certificate is unknown: it is none of those that are trusted"
ENDED = "the peer ended the connection instead of agreeing on TLS"
NO_TLS = "the peer does not speak TLS"
REFUSES = "the peer ended the connection before any reply; it may have refused the certificate"
OTHER_TLS = "the peer has no version or cipher suite of TLS that is ours, 1.2 or 1.3"

FLAWS = {
    2: UNKNOWN,
    9: "the certificate is not valid yet",
    10: "the certificate expired",
    18: UNKNOWN,
    19: UNKNOWN,
    20: UNKNOWN,
    21: UNKNOWN,
    26: "the certificate is not one for servers",
}
"""What is wrong with a certificate, by the code of OpenSSL."""

NAMES = (62, 64)
"""The codes for another host name, another address."""

_REFUSED = "the peer refused the certificate: "
REASONS = {
    "HTTP_REQUEST": NO_TLS,
    "INVALID_CONTENT_TYPE": NO_TLS,
    "PACKET_LENGTH_TOO_LONG": NO_TLS,
    "RECORD_LAYER_FAILURE": NO_TLS,
    "WRONG_VERSION_NUMBER": NO_TLS,
    "TLSV1_ALERT_INSUFFICIENT_SECURITY": OTHER_TLS,
    "TLSV1_ALERT_PROTOCOL_VERSION": OTHER_TLS,
    "UNSUPPORTED_PROTOCOL": OTHER_TLS,
    "TLSV13_ALERT_CERTIFICATE_REQUIRED": "the peer asks for a certificate",
    "SSLV3_ALERT_HANDSHAKE_FAILURE": (
        "the peer refused the handshake: it may ask for a certificate, or has no cipher suite that "
        "is ours"
    ),
    "TLSV1_ALERT_UNKNOWN_CA": f"{_REFUSED}it does not know its issuer",
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": f"{_REFUSED}expired",
    "SSLV3_ALERT_CERTIFICATE_REVOKED": f"{_REFUSED}revoked",
    "TLSV1_ALERT_ACCESS_DENIED": f"{_REFUSED}access denied",
    "SSLV3_ALERT_UNSUPPORTED_CERTIFICATE": f"{_REFUSED}of a kind that it does not take",
    "SSLV3_ALERT_BAD_CERTIFICATE": f"{_REFUSED}bad",
    "SSLV3_ALERT_CERTIFICATE_UNKNOWN": f"{_REFUSED}bad",
}
"""What ended a connection, by the reason of OpenSSL."""


def context(tls: Tls) -> ssl.SSLContext:
    """Checks the certificate of the peer and its name; the files are read now.

    Raises `OSError` for files that can't be used.
    """
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    made.set_ciphers(CIPHERS)
    made.hostname_checks_common_name = False
    # A device's own certificate is trusted without the one that issued it.
    made.verify_flags = ssl.VERIFY_X509_TRUSTED_FIRST | ssl.VERIFY_X509_PARTIAL_CHAIN
    if tls.ca is None:
        made.load_default_certs()
    else:
        made.load_verify_locations(tls.ca)
    if tls.cert is not None:
        # A password is given lest OpenSSL ask for one on the terminal.
        made.load_cert_chain(tls.cert, tls.key, password="")
    return made


def not_agreed(error: Exception, name: str) -> str:
    """Why there is no connection to a peer whose certificate is to have that name."""
    if isinstance(error, ssl.SSLCertVerificationError):
        if error.verify_code in NAMES:
            return f"the certificate is not for {name!r}"
        return FLAWS.get(error.verify_code, f"the certificate: {error.verify_message}")
    if isinstance(error, ssl.SSLEOFError | ConnectionResetError | BrokenPipeError):
        return ENDED
    return told(error)


def told(error: Exception, *, heard: bool = True) -> str:
    """What ended a connection; `heard` says whether the peer had replied on it."""
    if not heard and isinstance(error, ConnectionResetError | BrokenPipeError):
        return f"{REFUSES}: {error}"  # A reset overtakes the alert that would say it.
    reason = error.reason if isinstance(error, ssl.SSLError) else ""
    return REASONS.get(reason, str(error))
