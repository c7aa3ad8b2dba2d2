"""Why a TLS handshake of OpenSSL failed, in the words of the core.

Clients of brokers use OpenSSL. All else uses the core, whose list of reasons this is.
"""

from __future__ import annotations

import re
import ssl

_CERTIFICATE = {
    2: "unknown_issuer",
    7: "bad_signature",
    9: "not_yet_valid",
    10: "expired",
    18: "unknown_issuer",
    19: "unknown_issuer",
    20: "unknown_issuer",
    21: "unknown_issuer",
    23: "revoked",
    24: "issuer_not_authority",
    25: "constraint_violated",
    26: "wrong_purpose",
    34: "unsupported_extension",
    47: "constraint_violated",
    48: "constraint_violated",
    62: "wrong_name",
    64: "wrong_name",
    66: "unsupported_certificate",
    67: "unsupported_certificate",
    68: "unsupported_certificate",
}
"""Reasons by the codes of OpenSSL's verification (X509_V_ERR_…)."""

_ERRORS = {
    "BAD_SIGNATURE": "bad_signature",
    "DECRYPTION_FAILED_OR_BAD_RECORD_MAC": "bad_record",
    "HTTP_REQUEST": "not_tls",
    "NO_PROTOCOLS_AVAILABLE": "no_common_version_or_cipher",
    "RECORD_LAYER_FAILURE": "not_tls",
    "UNSUPPORTED_PROTOCOL": "no_common_version_or_cipher",
    "VERSION_TOO_LOW": "no_common_version_or_cipher",
    "WRONG_VERSION_NUMBER": "not_tls",
}
"""Reasons by OpenSSL's names of errors."""

_ALERTS = {
    "ACCESS_DENIED": "peer_refused_certificate",
    "BAD_CERTIFICATE": "peer_refused_certificate",
    "CERTIFICATE_EXPIRED": "peer_refused_certificate",
    "CERTIFICATE_REQUIRED": "peer_requires_certificate",
    "CERTIFICATE_REVOKED": "peer_refused_certificate",
    "CERTIFICATE_UNKNOWN": "peer_refused_certificate",
    "HANDSHAKE_FAILURE": "peer_refused_handshake",
    "INSUFFICIENT_SECURITY": "no_common_version_or_cipher",
    "PROTOCOL_VERSION": "no_common_version_or_cipher",
    "UNKNOWN_CA": "peer_refused_certificate",
    "UNSUPPORTED_CERTIFICATE": "peer_refused_certificate",
}
"""Reasons by the names of alerts (RFC 8446, 6)."""

_ALERT = re.compile(r"(?:SSLV3|TLSV1|TLSV13)_ALERT_(?P<name>\w+)")
"""OpenSSL's name of the error for an alert of the peer."""


def tls_reason(error: ssl.SSLError) -> str:
    """Returns why TLS failed: one of the core's `TLS_REASONS`."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return _CERTIFICATE.get(error.verify_code, "untrusted_certificate")
    if isinstance(error, ssl.SSLEOFError | ssl.SSLZeroReturnError):
        return "closed_during_handshake"
    # Errors that OpenSSL has not raised lack the attribute.
    name = getattr(error, "reason", None) or ""
    if alert := _ALERT.fullmatch(name):
        return _ALERTS.get(alert["name"], "peer_ended")
    return _ERRORS.get(name, "other")


def failure_text(error: BaseException) -> str:
    """Returns why a connection to a broker failed, for people; for TLS, the reason comes first."""
    text = str(error) or type(error).__name__
    # The end of a connection has the same error long after the handshake.
    if isinstance(error, ssl.SSLError) and not isinstance(error, ssl.SSLEOFError):
        return f"{tls_reason(error)}: {text}"
    return text
