"""The packets between a client and a broker, without keeping a large one in memory."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from holdfast.net.mqtt.packets import variable_integer

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterator

    from holdfast.net.secure_channel import SecureChannel


class Packets:
    """Packets from pieces of a byte stream."""

    def __init__(self, most: int, kept: int) -> None:
        """Of a packet with more than `most` bytes, `kept` are kept."""
        self._most, self._kept = most, kept
        self._left = b""
        """The beginning of a packet, before its body."""
        self._first = self._size = self._missing = 0
        """Of a packet whose body is not complete: first byte, size, and bytes to come."""
        self._body = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes | bytearray, int]]:
        """Yields the first byte, the body and the uncut size of each packet that is complete.

        Take all of them before the next call. Raises `ValueError`.
        """
        if self._missing:
            rest = self._missing
            self._add(data[:rest])
            yield from self._completed()
            data = data[rest:]
        data = self._left + data
        at, end, most = 0, len(data), self._most
        while end - at >= 2:
            size, start = data[at + 1], at + 2
            if size > 127:
                long = variable_integer(data, at + 1)
                if long is None:
                    break
                size, start = long
            finish = start + size
            if finish > end or size > most:
                self._first, self._size, self._missing = data[at], size, size
                self._add(data[start:finish])
                yield from self._completed()
            else:
                yield data[at], data[start:finish], size
            at = finish
        self._left = data[at:]

    def _add(self, part: bytes) -> None:
        limit = self._size if self._size <= self._most else self._kept
        self._body += part[: limit - len(self._body)]
        self._missing -= len(part)

    def _completed(self) -> Iterator[tuple[int, bytearray, int]]:
        if self._missing:
            return
        body, self._body = self._body, bytearray()
        yield self._first, body, self._size


class BrokerSocket:
    """What paho takes for its socket: it receives the packets that are put into `for_paho`.

    Packets that can't be sent at once wait in it, those of paho and those of `put` in their order.
    """

    def __init__(self, connection: socket.socket, channel: SecureChannel | None = None) -> None:
        """`connection` does not block. With a `channel`, it carries TLS."""
        self.connection = connection
        self._channel = channel
        self.for_paho = bytearray()
        self.failure: Exception | None = None
        """Why the connection has ended: an `OSError`, or an `EOFError` if the broker closed it."""
        self.is_open = True
        self._unsent: deque[bytes | memoryview] = deque()

    @property
    def unsent(self) -> int:
        """The number of packets, or of batches of them, that wait."""
        return len(self._unsent)

    def read(self, size: int) -> bytes:
        """Returns what has arrived; nothing if that is nothing, or the connection has ended."""
        try:
            data = self.connection.recv(size)
            if not data:
                self._end()
            elif self._channel is not None:
                return self._decrypted(self._channel, data)
        except BlockingIOError:
            return b""
        except OSError as error:
            self.failure = error
            return b""
        return data

    def _end(self) -> None:
        if self._channel is not None:
            self._channel.check_lost()
        self.failure = EOFError("the broker closed the connection")

    def _decrypted(self, channel: SecureChannel, data: bytes) -> bytes:
        try:
            return channel.receive(data)
        finally:
            self._send(channel.outgoing())

    def greet(self) -> None:
        """Begins TLS."""
        if self._channel is not None:
            self._send(self._channel.outgoing())

    def put(self, packets: bytes) -> None:
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
            self.failure = error

    # What paho calls.

    def recv(self, buffer_size: int) -> bytes:
        """Returns a part of `for_paho`, and then tells how the connection ended."""
        if self.for_paho:
            data = bytes(self.for_paho[:buffer_size])
            del self.for_paho[:buffer_size]
            return data
        if isinstance(self.failure, OSError):
            raise self.failure
        if self.failure is None:
            raise BlockingIOError
        return b""

    def send(self, buffer: bytes | bytearray) -> int:
        """Takes a packet."""
        self.put(bytes(buffer))
        if isinstance(self.failure, OSError):
            raise self.failure
        return len(buffer)

    def close(self) -> None:
        """Closes the connection."""
        if self.is_open and self._channel is not None and self.failure is None:
            self._send(self._channel.end())
        self.is_open = False
        self.connection.close()

    def fileno(self) -> int:
        """The descriptor of the connection."""
        return self.connection.fileno()

    def setblocking(self, flag: bool) -> None:
        """Does nothing: the connection does not block."""
