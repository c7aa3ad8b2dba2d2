"""TLS between a socket and an HTTP connection.

A connection has its limits and deadlines from the start, before the handshake, and is answered in
plain HTTP if it does not speak TLS. `asyncio` has TLS of its own, which begins before a connection
is known, and can't do either.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
import time
from typing import Any, Protocol

HANDSHAKE = b"\x16"
"""The first byte of TLS: a record with a handshake message."""

CHUNK = 65536

_VERIFICATION = {
    2: "unknown_issuer",
    3: "unknown_revocation",
    8: "unknown_revocation",
    9: "not_yet_valid",
    10: "expired",
    12: "expired_revocation_list",
    18: "unknown_issuer",
    19: "unknown_issuer",
    20: "unknown_issuer",
    21: "unknown_issuer",
    23: "revoked",
    26: "wrong_purpose",
    34: "unsupported_extension",
    36: "unknown_revocation",
}
"""Reasons by the error codes of OpenSSL's verification (X509_V_ERR_…)."""

_REASONS = {
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": "no_certificate",
    "UNSUPPORTED_PROTOCOL": "no_common_version_or_cipher",
    "VERSION_TOO_LOW": "no_common_version_or_cipher",
    "NO_SHARED_CIPHER": "no_common_version_or_cipher",
    "NO_SUITABLE_KEY_SHARE": "no_common_version_or_cipher",
    "NO_SUITABLE_GROUPS_KEY_SHARE": "no_common_version_or_cipher",
    "NO_SUITABLE_SIGNATURE_ALGORITHM": "no_common_version_or_cipher",
    "NO_SHARED_SIGNATURE_ALGORITHMS": "no_common_version_or_cipher",
    "WRONG_VERSION_NUMBER": "not_tls",
    "HTTP_REQUEST": "not_tls",
    "DECRYPTION_FAILED_OR_BAD_RECORD_MAC": "bad_record",
    "BAD_SIGNATURE": "bad_signature",
}
"""Reasons by OpenSSL's names of errors."""

_ALERTS = {
    "UNKNOWN_CA": "peer_refused_certificate",
    "CERTIFICATE_EXPIRED": "peer_refused_certificate",
    "CERTIFICATE_REVOKED": "peer_refused_certificate",
    "ACCESS_DENIED": "peer_refused_certificate",
    "UNSUPPORTED_CERTIFICATE": "peer_refused_certificate",
    "BAD_CERTIFICATE": "peer_refused_certificate",
    "CERTIFICATE_UNKNOWN": "peer_refused_certificate",
    "HANDSHAKE_FAILURE": "peer_refused_handshake",
    "PROTOCOL_VERSION": "no_common_version_or_cipher",
    "INSUFFICIENT_SECURITY": "no_common_version_or_cipher",
}
"""Reasons by the names of the alerts of a peer."""


class Plain(Protocol):
    """The connection inside TLS."""

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Called before the handshake."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Called at the end of the connection."""

    def data_received(self, data: bytes) -> None:
        """Called with plain text."""

    def eof_received(self) -> bool:
        """Called when the peer sends no more. Returns whether it may still get something."""

    def pause_writing(self) -> None:
        """Called when the peer reads slowly."""

    def resume_writing(self) -> None:
        """Called when everything was sent."""

    def begun(self) -> None:
        """Called with the first bytes of the peer."""

    def tls_failed(self, reason: str) -> None:
        """Called when TLS failed, before the connection is closed."""

    def plain_answer(self) -> bytes:
        """Returns the HTTP response for a peer that does not use TLS."""


def reason(error: ssl.SSLError) -> str:
    """Returns why TLS failed, as a word for the log."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return _VERIFICATION.get(error.verify_code, "untrusted_certificate")
    name = str(error.reason)
    if "_ALERT_" in name:
        return _ALERTS.get(name.partition("_ALERT_")[2], "peer_ended")
    return _REASONS.get(name, "other")


class TlsTransport(asyncio.Transport, asyncio.Protocol):
    """The protocol of a socket, and the transport of the connection inside TLS."""

    def __init__(self, context: ssl.SSLContext, plain: Plain) -> None:
        super().__init__()
        self.handshaking = True
        self._plain = plain
        self._raw: asyncio.Transport
        self._context = context
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=True)
        self._begun = False
        self._deaf = False
        """Whether bytes of the peer are ignored."""

    # Called by the socket's transport.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Starts TLS, unless the connection is refused."""
        assert isinstance(transport, asyncio.Transport)
        self._raw = transport
        self._plain.connection_made(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Ends the connection."""
        self._plain.connection_lost(exc)

    def pause_writing(self) -> None:
        """Passed on."""
        self._plain.pause_writing()

    def resume_writing(self) -> None:
        """Passed on."""
        self._plain.resume_writing()

    def data_received(self, data: bytes) -> None:
        """Continues the handshake, or passes on plain text."""
        if self._deaf or self._raw.is_closing():
            return
        if not self._begun:
            self._begun = True
            self._plain.begun()
            if data[:1] != HANDSHAKE:
                self._refuse_plain(data)
                return
        self._incoming.write(data)
        try:
            if self.handshaking:
                self._tls.do_handshake()
                self.handshaking = False
                if self._is_outdated():
                    self._fail("expired")
                    return
            plain, ended = self._read()
        except ssl.SSLWantReadError:
            self._flush()
        except ssl.SSLError as error:
            self._fail(reason(error))
        else:
            self._flush()
            if plain:
                self._plain.data_received(plain)
            if ended:
                self._end()

    def eof_received(self) -> bool:
        """The peer sends no more."""
        if self._deaf:
            return not self.handshaking
        if self.handshaking:
            if self._begun:
                self._plain.tls_failed("closed_during_handshake")
            return False
        self._deaf = True
        return self._plain.eof_received()

    # Called by the connection.

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Returns information about the socket, or `sslcontext` or `handshaking` about TLS."""
        if name == "handshaking":
            return self.handshaking
        return self._context if name == "sslcontext" else self._raw.get_extra_info(name, default)

    def is_closing(self) -> bool:
        """Returns whether the connection is closed or about to be."""
        return self._raw.is_closing()

    def write(self, data: Any) -> None:
        """Encrypts and sends."""
        if self.handshaking or self._raw.is_closing():
            return
        rest = memoryview(data)
        try:
            while rest:  # One call may take a part only.
                rest = rest[self._tls.write(rest) :]
        except ssl.SSLError as error:
            self._fail(reason(error))
        else:
            self._flush()

    def close(self) -> None:
        """Closes the connection after what was written. Does not wait for the peer's answer."""
        if self._raw.is_closing():
            return
        if not self.handshaking:
            with contextlib.suppress(ssl.SSLError):
                self._tls.unwrap()
            self._flush()
        self._raw.close()

    def abort(self) -> None:
        """Drops the connection."""
        self._raw.abort()

    def pause_reading(self) -> None:
        """Stops reading from the socket."""
        self._raw.pause_reading()

    def resume_reading(self) -> None:
        """Reads again."""
        self._raw.resume_reading()

    def is_reading(self) -> bool:
        """Returns whether the socket is read."""
        return self._raw.is_reading()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Sets the limits of the socket's buffer."""
        self._raw.set_write_buffer_limits(high, low)

    # Steps.

    def _read(self) -> tuple[bytes, bool]:
        """Returns the plain text of all complete records, and whether the peer has ended TLS."""
        plain = bytearray()
        try:
            while data := self._tls.read(CHUNK):
                plain += data
        except ssl.SSLWantReadError:
            return bytes(plain), False
        except ssl.SSLZeroReturnError:
            pass
        return bytes(plain), True

    def _end(self) -> None:
        self._deaf = True
        if not self._plain.eof_received():
            self.close()

    def _is_outdated(self) -> bool:
        """Returns whether a resumed session has a certificate that has expired in the meantime."""
        if self._context.verify_mode != ssl.CERT_REQUIRED or not self._tls.session_reused:
            return False
        ends = (self._tls.getpeercert() or {}).get("notAfter")
        return not isinstance(ends, str) or ssl.cert_time_to_seconds(ends) <= time.time()

    def _flush(self) -> None:
        if self._outgoing.pending:
            self._raw.write(self._outgoing.read())

    def _fail(self, why: str) -> None:
        """Sends the alert of OpenSSL, and closes the connection."""
        self._plain.tls_failed(why)
        self._flush()
        self._raw.close()

    def _refuse_plain(self, data: bytes) -> None:
        """Answers an HTTP request without TLS; closes anything else."""
        self._plain.tls_failed("not_tls")
        if not data[:1].isalpha():
            self._raw.close()
            return
        # What still arrives is ignored: with unread bytes, closing could destroy the response.
        self._deaf = True
        self._raw.write(self._plain.plain_answer())
        if self._raw.can_write_eof():
            self._raw.write_eof()
