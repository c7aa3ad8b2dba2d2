"""A device that does with each request what a test tells it, on every transport.

It shares nothing with the library. What it is not told it does as a good device: it has 1000 items
in every area, and holding register N holds N.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import threading
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from support import lines, wire
from support.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    Behaviour = Callable[["Asked"], object]

AREAS = ("coils", "discrete_inputs", "holding_registers", "input_registers")
STREAMS = ("tcp", "rtu+tcp")
DATAGRAMS = ("udp", "rtu+udp")
LINES = ("rtu", "ascii")


def good_unit() -> Oracle:
    """A unit 1 as described above."""
    oracle = Oracle(dict.fromkeys(AREAS, (0, 1000)))
    oracle.values["holding_registers"] = {address: address for address in range(1000)}
    return oracle


class Asked:
    """A request that came, and what can be done about it."""

    def __init__(self, peer: Peer, frame: bytes, parts: tuple[int, int, bytes]) -> None:
        self.peer = peer
        self.raw = frame
        self.transaction, self.unit, self.pdu = parts
        self.reply = b""
        """The PDU of a good answer."""

    def frame(
        self, pdu: bytes | None = None, *, unit: int | None = None, transaction: int | None = None
    ) -> bytes:
        """A frame of the transport; a good reply but for what is given."""
        return self.peer.framing.frame(
            self.reply if pdu is None else pdu,
            self.unit if unit is None else unit,
            self.transaction if transaction is None else transaction,
        )

    def answer(self, pdu: bytes | None = None, **header: int) -> None:
        """Sends such a frame."""
        self.send(self.frame(pdu, **header))

    def send(self, *pieces: bytes) -> None:
        for piece in pieces:
            self.peer.send(piece)

    def drip(self, data: bytes) -> None:
        """Sends byte by byte."""
        self.send(*[bytes([byte]) for byte in data])


class Framing(ABC):
    """How requests are cut out of what came, and how replies are framed."""

    @abstractmethod
    def frame(self, pdu: bytes, unit: int, transaction: int) -> bytes:
        """A frame."""

    @abstractmethod
    def cut(self, received: bytes) -> tuple[int, tuple[int, int, bytes]] | None:
        """The length of the request at the start, and its transaction id, unit id and PDU."""


class Mbap(Framing):
    def frame(self, pdu: bytes, unit: int, transaction: int) -> bytes:
        return wire.frame(pdu, unit, transaction & 0xFFFF)

    def cut(self, received: bytes) -> tuple[int, tuple[int, int, bytes]] | None:
        whole, _ = wire.split(received)
        if not whole:
            return None
        first = whole[0]
        return 7 + len(first.pdu), (first.transaction, first.unit, first.pdu)


class OnLine(Framing):
    """RTU or ASCII, on a line or over TCP."""

    def __init__(self, mode: lines.Mode) -> None:
        self.mode = mode

    def frame(self, pdu: bytes, unit: int, transaction: int) -> bytes:  # noqa: ARG002
        return self.mode.frame(pdu, unit)

    def cut(self, received: bytes) -> tuple[int, tuple[int, int, bytes]] | None:
        length = request_length if self.mode is lines.RTU else lines.ascii_length
        end = length(received)
        if end is None or len(received) < end:
            return None
        unit, pdu = self.mode.unframe(received[:end])
        return end, (0, unit, pdu)


def request_length(received: bytes) -> int | None:
    """Bytes of the RTU request at the start of some bytes."""
    if len(received) < 2:
        return None
    code = received[1]
    counted = {15: 6, 16: 6, 23: 10}.get(code)
    if counted is None:
        return {11: 4, 17: 4, 22: 10, 43: 7}.get(code, 8)
    return None if len(received) <= counted else counted + 3 + received[counted]


class Peer:
    """Somebody who asks: a connection, an address, or the other end of a line."""

    def __init__(self, framing: Framing) -> None:
        self.framing = framing
        self.received = b""

    def send(self, data: bytes) -> None:
        raise NotImplementedError


class Connection(Peer):
    def __init__(self, framing: Framing, made: socket.socket) -> None:
        super().__init__(framing)
        self.socket = made
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        # The client may be gone.
        with contextlib.suppress(OSError):
            self.socket.sendall(data)

    def close(self) -> None:
        """Ends it in good order."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def reset(self) -> None:
        """Ends it with RST."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()


class Sender(Peer):
    """Whoever sent a datagram."""

    def __init__(self, framing: Framing, own: socket.socket, address: Any) -> None:
        super().__init__(framing)
        self.own = own
        self.address = address

    def send(self, data: bytes) -> None:
        self.own.sendto(data, self.address)


class Wire(Peer):
    """The other end of a line."""

    def __init__(self, framing: Framing, terminal: lines.Terminal) -> None:
        super().__init__(framing)
        self.terminal = terminal

    def send(self, data: bytes) -> None:
        while data:
            select.select([], [self.terminal.end], [], wire.DEADLINE)
            data = data[os.write(self.terminal.end, data) :]


def good(asked: Asked) -> None:
    """Answers as it should be."""
    asked.answer()


def silent(asked: Asked) -> None:
    """Does nothing."""


class Hostile(ABC):
    """A device, from construction to `stop`.

    The first request is given to the first of `script`, and so on; all further ones to the last
    one's successor, `then`.
    """

    url: str

    def __init__(self, *script: Behaviour, then: Behaviour = good) -> None:
        self.script = list(script)
        self.then = then
        self.oracle = good_unit()
        self.asked: list[Asked] = []
        """All requests that came, in their order."""
        self.connections = 0
        self._ended, self._end = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="hostile")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._end)
        self._thread.join()
        os.close(self._ended)
        self.release()

    def await_requests(self, count: int) -> None:
        """Waits until exactly so many requests have come."""
        wire.until(lambda: len(self.asked) >= count, f"{count} requests have come")
        assert len(self.asked) == count

    @abstractmethod
    def sources(self) -> list[Any]:
        """What can be read."""

    @abstractmethod
    def read(self, source: Any) -> Peer | None:
        """Reads; who has sent something."""

    @abstractmethod
    def release(self) -> None:
        """Gives everything back."""

    def _serve(self) -> None:
        while True:
            ready, _, _ = select.select([self._ended, *self.sources()], [], [])
            if self._ended in ready:
                return
            for source in ready:
                peer = self.read(source)
                while peer is not None and (found := peer.framing.cut(peer.received)):
                    end, parts = found
                    asked = Asked(peer, peer.received[:end], parts)
                    peer.received = peer.received[end:]
                    self._deal_with(asked)

    def _deal_with(self, asked: Asked) -> None:
        asked.reply = self.oracle.answer(asked.unit, asked.pdu) or b""
        number = len(self.asked)
        self.asked.append(asked)
        behaviour = self.script[number] if number < len(self.script) else self.then
        behaviour(asked)


def framing_of(kind: str) -> Framing:
    """The framing of a scheme."""
    frames = kind.partition("+")[0]
    return OnLine({"rtu": lines.RTU, "ascii": lines.ASCII}[frames]) if frames in LINES else Mbap()


class Stream(Hostile):
    """Behind TCP: MBAP, RTU or ASCII frames.

    `greet` is done with each connection first; a device that is `deaf` reads nothing.
    """

    def __init__(
        self,
        kind: str,
        *script: Behaviour,
        then: Behaviour = good,
        greet: Callable[[Connection, int], object] = lambda *_: None,
        deaf: bool = False,
    ) -> None:
        super().__init__(*script, then=then)
        self._framing = framing_of(kind)
        self._greet = greet
        self._deaf = deaf
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._peers: list[Connection] = []
        self.port: int = self._listener.getsockname()[1]
        self.url = f"{kind}://127.0.0.1:{self.port}"

    def sources(self) -> list[Any]:
        peers = [] if self._deaf else self._peers
        return [self._listener, *[peer.socket for peer in peers if peer.socket.fileno() >= 0]]

    def read(self, source: Any) -> Peer | None:
        if source is self._listener:
            made, _ = self._listener.accept()
            peer = Connection(self._framing, made)
            self._peers.append(peer)
            self.connections += 1
            self._greet(peer, self.connections)
            return None
        [peer] = [peer for peer in self._peers if peer.socket is source]
        try:
            data = peer.socket.recv(65536)
        except OSError:
            data = b""
        if not data:
            peer.socket.close()
            return None
        peer.received += data
        return peer

    def release(self) -> None:
        self._listener.close()
        for peer in self._peers:
            peer.socket.close()


class Udp(Hostile):
    """Behind UDP: MBAP or RTU frames."""

    def __init__(self, *script: Behaviour, then: Behaviour = good, kind: str = "udp") -> None:
        super().__init__(*script, then=then)
        self._framing = framing_of(kind)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.url = f"{kind}://127.0.0.1:{self._socket.getsockname()[1]}"

    def sources(self) -> list[Any]:
        return [self._socket]

    def read(self, source: Any) -> Peer:  # noqa: ARG002
        data, address = self._socket.recvfrom(65536)
        peer = Sender(self._framing, self._socket, address)
        peer.received = data
        return peer

    def release(self) -> None:
        self._socket.close()


class Serial(Hostile):
    """On a line."""

    def __init__(
        self,
        mode: lines.Mode,
        device: Path,
        *script: Behaviour,
        then: Behaviour = good,
        **options: object,
    ) -> None:
        super().__init__(*script, then=then)
        self.terminal = lines.Terminal(device)
        self._peer = Wire(OnLine(mode), self.terminal)
        query = "&".join(f"{key}={value}" for key, value in {"parity": "none", **options}.items())
        self.url = f"{mode.name}://{device}?{query}"

    def sources(self) -> list[Any]:
        return [self.terminal.end]

    def read(self, source: Any) -> Peer:  # noqa: ARG002
        # Nobody may be there.
        with contextlib.suppress(OSError):
            self._peer.received += os.read(self.terminal.end, 65536)
        return self._peer

    def release(self) -> None:
        self.terminal.close()
