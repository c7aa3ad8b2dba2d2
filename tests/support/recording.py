"""A proxy that records what a client and a server send, and writes it as a capture file.

Capturing on an interface requires privileges. The proxy requires none: it builds the headers of IP,
TCP and UDP itself, around the bytes that passed.
"""

from __future__ import annotations

import selectors
import socket
import struct
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import Self

CLIENT_PORT = 40000
MODBUS_PORT = 502
"""The ports in capture files, whatever the real ones were."""

RAW_IP = 101
ACKNOWLEDGE_PUSH = 0x18
LOOPBACK = socket.inet_aton("127.0.0.1")


@dataclass(frozen=True)
class Piece:
    """Bytes that arrived at once."""

    from_client: bool
    data: bytes


class Recorder:
    """A proxy for one client of a server, over TCP or UDP."""

    def __init__(self, server: tuple[str, int], *, datagrams: bool) -> None:
        self.pieces: list[Piece] = []
        self._datagrams = datagrams
        self._server = server
        kind = socket.SOCK_DGRAM if datagrams else socket.SOCK_STREAM
        self._listener = socket.socket(socket.AF_INET, kind)
        self._listener.bind(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._upstream = socket.socket(socket.AF_INET, kind)
        self._upstream.connect(server)
        self._end, self._ended = socket.socketpair()
        if not datagrams:
            self._listener.listen(1)
        self._thread = threading.Thread(target=self._carry, name="recorder")
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end.close()
        self._thread.join()
        for each in (self._listener, self._upstream, self._ended):
            each.close()

    def _carry(self) -> None:
        """Carries bytes in both directions until the end."""
        with selectors.DefaultSelector() as ready:
            ready.register(self._ended, selectors.EVENT_READ)
            ready.register(self._listener, selectors.EVENT_READ)
            ready.register(self._upstream, selectors.EVENT_READ)
            client = self._listener if self._datagrams else None
            while True:
                arrived = {key.fileobj for key, _ in ready.select()}
                if self._ended in arrived:
                    break
                if client is None and self._listener in arrived:
                    client, _ = self._listener.accept()
                    ready.unregister(self._listener)
                    ready.register(client, selectors.EVENT_READ)
                elif client is not None and client in arrived and not self._request(client):
                    ready.unregister(client)
                if self._upstream in arrived:
                    data = self._upstream.recv(65536)
                    assert data, "the server has closed the connection"
                    self.pieces.append(Piece(False, data))
                    assert client is not None
                    self._reply(client, data)
        if client is not None:
            client.close()

    def _request(self, client: socket.socket) -> bool:
        """Carries bytes to the server. Returns whether there were any: the client did not close."""
        data, self._peer = client.recvfrom(65536)
        if data:
            self.pieces.append(Piece(True, data))
            self._upstream.sendall(data)
        return bool(data)

    def _reply(self, client: socket.socket, data: bytes) -> None:
        if self._datagrams:
            client.sendto(data, self._peer)
        else:
            client.sendall(data)


def write(pieces: list[Piece], file: Path, *, datagrams: bool) -> None:
    """Writes a capture file, with a packet for each piece."""
    with file.open("wb") as capture:
        capture.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, RAW_IP))
        for number, packet in enumerate(packets(pieces, datagrams=datagrams)):
            header = struct.pack("<IIII", number // 1000, number % 1000, len(packet), len(packet))
            capture.write(header + packet)


def packets(pieces: list[Piece], *, datagrams: bool) -> list[bytes]:
    """Builds an IP packet for each piece."""
    sent = {True: 1, False: 1}
    made = []
    for piece in pieces:
        ports = (CLIENT_PORT, MODBUS_PORT) if piece.from_client else (MODBUS_PORT, CLIENT_PORT)
        if datagrams:
            header = struct.pack(">HHHH", *ports, 8 + len(piece.data), 0)
        else:
            numbers = sent[piece.from_client], sent[not piece.from_client]
            flags = (5 << 12) | ACKNOWLEDGE_PUSH
            header = struct.pack(">HHIIHHHH", *ports, *numbers, flags, 65535, 0, 0)
        sent[piece.from_client] += len(piece.data)
        made.append(
            ip(header + piece.data, socket.IPPROTO_UDP if datagrams else socket.IPPROTO_TCP)
        )
    return made


def ip(payload: bytes, protocol: int) -> bytes:
    """Builds an IPv4 packet on the loopback interface. Checksums are 0: not calculated."""
    length = 20 + len(payload)
    start = struct.pack(">BBHHHBBH", 0x45, 0, length, 0, 0, 64, protocol, 0)
    return start + LOOPBACK + LOOPBACK + payload
