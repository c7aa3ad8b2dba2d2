"""TLS for connections to brokers: the core verifies their certificates like those of devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast._core import Endpoint, TlsChannel
from holdfast.protocol import TLS_PORT
from holdfast.runtime.bounded_files import require_stored
from holdfast.runtime.text import os_error_text

if TYPE_CHECKING:
    from holdfast.net.tls import Tls


class TlsRefused(ConnectionError):
    """TLS failed. `reason` is a word from docs/modbus-tls.md, such as `expired`."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def failure_text(error: BaseException) -> str:
    """Returns why a connection to a service failed, for people; for TLS, the reason comes first."""
    text = str(error)
    if isinstance(error, OSError) and error.filename is None:
        text = os_error_text(error)
    text = text or type(error).__name__
    return f"{error.reason}: {text}" if isinstance(error, TlsRefused) else text


class SecureChannel:
    """The client side of TLS 1.2 and 1.3 over a connection whose socket belongs to the caller.

    Send `outgoing` after the start, and after each call of `receive`, even if that fails.
    """

    def __init__(self, host: str, tls: Tls) -> None:
        """Reads the files, so renewed certificates need no restart. `host` is the expected name.

        Raises `OSError` for an unusable file.
        """
        require_stored(tls.ca, tls.cert, tls.key)
        try:
            endpoint = Endpoint.tls(host, TLS_PORT, tls.ca, tls.cert, tls.key, tls.name)
        except ValueError as error:
            raise OSError(str(error)) from error
        self._channel = TlsChannel(endpoint)

    @property
    def is_ready(self) -> bool:
        """Whether the handshake is complete."""
        return self._channel.is_ready

    def outgoing(self) -> bytes:
        """Takes the bytes to send now."""
        return self._channel.outgoing()

    def encrypted(self, data: bytes) -> bytes:
        """Returns the bytes that carry data. Call it after the handshake."""
        self._channel.send(data)
        return self._channel.outgoing()

    def receive(self, data: bytes) -> bytes:
        """Returns the data in received bytes. Raises `TlsRefused`."""
        plain, failure = self._channel.receive(data)
        if failure is not None:
            raise TlsRefused(*failure[:2])
        return plain

    def end(self) -> bytes:
        """Returns the bytes that announce the end."""
        self._channel.end()
        return self._channel.outgoing()

    def check_lost(self) -> None:
        """Raises `TlsRefused` if the connection has ended during the handshake."""
        failure = None if self.is_ready else self._channel.lost(broken=False)
        if failure is not None:
            raise TlsRefused(*failure[:2])
