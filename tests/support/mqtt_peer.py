"""The broker's side of MQTT at the byte level, independent of any MQTT library.

It sends whatever a test requires, including malformed packets. Every wait has a deadline.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
from typing import TYPE_CHECKING, NamedTuple

from support import wire

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

CONNECT, CONNACK, PUBLISH, PUBACK, PUBREC, PUBREL, PUBCOMP = range(1, 8)
SUBSCRIBE, SUBACK, UNSUBSCRIBE, UNSUBACK, PINGREQ, PINGRESP, DISCONNECT = range(8, 15)

SESSION_EXPIRY, RESPONSE_TOPIC, CORRELATION = 17, 8, 9
RECEIVE_MAXIMUM, MAXIMUM_QOS, MAXIMUM_PACKET_SIZE = 33, 36, 39


class Packet(NamedTuple):
    kind: int
    flags: int
    body: bytes

    @property
    def identifier(self) -> int:
        """The packet identifier of an acknowledgement or a subscription."""
        return int.from_bytes(self.body[:2], "big")


def variable(number: int) -> bytes:
    """Encodes a variable byte integer."""
    digits = bytearray()
    while True:
        number, digit = divmod(number, 128)
        digits.append(digit | (0x80 if number else 0))
        if not number:
            return bytes(digits)


def packet(kind: int, body: bytes = b"", flags: int = 0) -> bytes:
    return bytes([kind << 4 | flags]) + variable(len(body)) + body


def string(text: str | bytes) -> bytes:
    raw = text.encode() if isinstance(text, str) else text
    return struct.pack(">H", len(raw)) + raw


def publish(
    topic: str | bytes,
    payload: str | bytes,
    qos: int = 0,
    identifier: int = 1,
    *,
    version: str = "5",
    properties: bytes = b"",
    again: bool = False,
) -> bytes:
    """Builds a PUBLISH; `again` sets the DUP flag."""
    head = string(topic) + (struct.pack(">H", identifier) if qos else b"")
    if version == "5":
        head += variable(len(properties)) + properties
    raw = payload.encode() if isinstance(payload, str) else payload
    return packet(PUBLISH, head + raw, qos << 1 | again << 3)


def acknowledge(kind: int, identifier: int) -> bytes:
    """Builds a PUBACK, PUBREC, PUBREL or PUBCOMP."""
    return packet(kind, struct.pack(">H", identifier), 2 if kind == PUBREL else 0)


class Peer:
    """A connection that an adapter opened."""

    def __init__(self, connection: socket.socket, version: str) -> None:
        self.socket = connection
        self.socket.settimeout(wire.DEADLINE)
        self._version = version

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def receive(self) -> Packet:
        """Returns the next packet. Raises `EOFError` at the end of the connection."""
        first = self._exactly(1)[0]
        size = shift = 0
        while True:
            digit = self._exactly(1)[0]
            size |= (digit & 0x7F) << shift
            shift += 7
            if digit < 0x80:
                break
        return Packet(first >> 4, first & 15, self._exactly(size))

    def expect(self, kind: int) -> Packet:
        """Returns the next packet that is not a PINGREQ, and checks its type."""
        while True:
            got = self.receive()
            if got.kind == kind:
                return got
            assert got.kind == PINGREQ, got

    def silent(self) -> bool:
        """Returns whether no unread bytes have arrived."""
        return not select.select([self.socket], [], [], 0)[0]

    def finish(self) -> None:
        """Half-closes the connection, if it is still open."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)

    def wait_until_closed(self) -> None:
        """Waits until the adapter closes the connection. Ignores what it sends."""
        try:
            while True:
                self.receive()
        except (EOFError, ConnectionError):
            pass

    def connack(self, code: int = 0, *, resumed: bool = False, properties: bytes = b"") -> None:
        body = bytes([resumed, code])
        if self._version == "5":
            body += variable(len(properties)) + properties
        self.send(packet(CONNACK, body))

    def welcome(self, *, resumed: bool = False, properties: bytes = b"") -> None:
        """Accepts the connection and one subscription."""
        self.expect(CONNECT)
        self.connack(resumed=resumed, properties=properties)
        self.suback(self.expect(SUBSCRIBE).identifier, 1)

    def suback(self, identifier: int, code: int) -> None:
        properties = b"\0" if self._version == "5" else b""
        self.send(packet(SUBACK, struct.pack(">H", identifier) + properties + bytes([code])))

    def _exactly(self, size: int) -> bytes:
        pieces = bytearray()
        while len(pieces) < size:
            piece = self.socket.recv(size - len(pieces))
            if not piece:
                raise EOFError
            pieces += piece
        return bytes(pieces)


class FakeBroker:
    """A listening socket. The test sends the answers."""

    def __init__(self, version: str = "5") -> None:
        self.version = version
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(wire.DEADLINE)
        self.url = f"mqtt://127.0.0.1:{self._server.getsockname()[1]}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._server.close()

    def accept(self) -> Peer:
        """Returns the next connection of the adapter."""
        return Peer(self._server.accept()[0], self.version)
