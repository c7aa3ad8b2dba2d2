"""HTTPS to a server of this machine, whose certificate is known from its configuration."""

from __future__ import annotations

import http.client
import ssl
from typing import TYPE_CHECKING

from holdfast.certificates.own import own_der

if TYPE_CHECKING:
    from pathlib import Path


class _Pinned(http.client.HTTPSConnection):
    def __init__(self, host: str, port: int, expected: bytes, timeout: float) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        # The certificate itself is compared, which is stricter than its name and its issuer.
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        super().__init__(host, port, timeout=timeout, context=context)
        self._expected = expected

    def connect(self) -> None:
        """Connects, and compares the certificate before anything is sent."""
        super().connect()
        assert isinstance(self.sock, ssl.SSLSocket)
        if self.sock.getpeercert(binary_form=True) != self._expected:
            self.close()
            raise ConnectionError("the server has another certificate than its configuration")


def pinned(host: str, port: int, cert_file: Path, *, timeout: float) -> http.client.HTTPSConnection:
    """Returns a connection to a server that has the first certificate of a file."""
    return _Pinned(host, port, own_der(cert_file), timeout)
