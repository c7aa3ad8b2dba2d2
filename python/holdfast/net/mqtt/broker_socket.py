"""The connection to a broker, as paho sees it."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import socket

    from holdfast.net.secure_channel import SecureChannel


class BrokerSocket:
    """The socket that paho uses: paho receives only the packets that are put into `paho_buffer`.

    Packets that can't be sent at once wait here, those of paho and of `send_to_broker` in order.
    """

    def __init__(self, connection: socket.socket, channel: SecureChannel | None = None) -> None:
        """`connection` does not block. With a `channel`, it carries TLS."""
        self.connection = connection
        self._channel = channel
        self.paho_buffer = bytearray()
        self.error: Exception | None = None
        """Why the connection has ended: an `OSError`, or an `EOFError` if the broker closed it."""
        self.is_open = True
        self._unsent: deque[bytes | memoryview] = deque()

    @property
    def unsent(self) -> int:
        """The number of packets, or of batches of them, that wait."""
        return len(self._unsent)

    def receive_from_broker(self, size: int) -> bytes:
        """Returns the bytes that have arrived: none also if the connection has ended, `error`."""
        try:
            data = self.connection.recv(size)
            if not data:
                self._end()
            elif self._channel is not None:
                return self._decrypted(self._channel, data)
        except BlockingIOError:
            return b""
        except OSError as error:
            self.error = error
            return b""
        return data

    def _end(self) -> None:
        if self._channel is not None:
            self._channel.check_lost()
        self.error = EOFError("the broker closed the connection")

    def _decrypted(self, channel: SecureChannel, data: bytes) -> bytes:
        try:
            return channel.receive(data)
        finally:
            self._send(channel.outgoing())

    def greet(self) -> None:
        """Begins TLS."""
        if self._channel is not None:
            self._send(self._channel.outgoing())

    def send_to_broker(self, packets: bytes) -> None:
        """Sends packets, now or when the broker takes more."""
        self._send(packets if self._channel is None else self._channel.encrypted(packets))

    def _send(self, data: bytes) -> None:
        if data:
            self._unsent.append(data)
            if len(self._unsent) == 1:
                self.flush()

    def flush(self) -> None:
        """Sends what waits, as far as the broker takes it."""
        try:
            while self._unsent:
                data = self._unsent[0]
                sent = self.connection.send(data)
                if sent < len(data):
                    self._unsent[0] = memoryview(data)[sent:]
                else:
                    self._unsent.popleft()
        except BlockingIOError:
            return
        except OSError as error:
            self.error = error

    # What paho calls.

    def recv(self, buffer_size: int) -> bytes:
        """Returns a part of `paho_buffer`, and then tells how the connection ended."""
        if self.paho_buffer:
            data = bytes(self.paho_buffer[:buffer_size])
            del self.paho_buffer[:buffer_size]
            return data
        if isinstance(self.error, OSError):
            raise self.error
        if self.error is None:
            raise BlockingIOError
        return b""

    def send(self, buffer: bytes | bytearray) -> int:
        """Takes a packet."""
        self.send_to_broker(bytes(buffer))
        if isinstance(self.error, OSError):
            raise self.error
        return len(buffer)

    def close(self) -> None:
        """Closes the connection."""
        if self.is_open and self._channel is not None and self.error is None:
            self._send(self._channel.end())
        self.is_open = False
        self.connection.close()

    def fileno(self) -> int:
        """The descriptor of the connection."""
        return self.connection.fileno()

    def setblocking(self, flag: bool) -> None:
        """Does nothing: the connection does not block."""
