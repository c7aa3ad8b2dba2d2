"""A device on every transport whose behaviour for each request a test defines.

It shares no code with the library. By default it behaves as a correct device: it has 1000 items in
every area, and holding register N holds N. For TLS, put a `secured.Relay` in front of it.
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
from support.server_model import ServerModel

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    Behaviour = Callable[["Asked"], object]
    Answer = Callable[[bytes], bytes | None]

AREAS = ("coils", "discrete_inputs", "holding_registers", "input_registers")
STREAMS = ("tcp", "rtu+tcp")
DATAGRAMS = ("udp", "rtu+udp")
LINES = ("rtu", "ascii")

HANG_UP = b""
"""Instead of a reply: closes the connection."""


def exception(pdu: bytes, code: int) -> bytes:
    return bytes([pdu[0] | 0x80, code])


def registers(pdu: bytes, value: int = 0) -> bytes:
    """Builds the reply to a read of registers; all have one value."""
    count = int.from_bytes(pdu[3:5])
    return bytes([pdu[0], 2 * count]) + value.to_bytes(2) * count


def whole_floats(code: int) -> Answer:
    """A meter with 150 floats in its input registers that refuses to read a part of one."""

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 4:
            return exception(pdu, 1)
        if first % 2 or count % 2:
            return exception(pdu, code)
        if first + count > 300:
            return exception(pdu, 2)
        return bytes([4, 2 * count]) + struct.pack(">f", 230.2) * (count // 2)

    return answers


def good_unit() -> ServerModel:
    """A unit 1 as described above."""
    model = ServerModel(dict.fromkeys(AREAS, (0, 1000)))
    model.values["holding_registers"] = {address: address for address in range(1000)}
    return model


class Asked:
    """A received request, and the possible answers."""

    def __init__(self, peer: Peer, frame: bytes, parts: tuple[int, int, bytes]) -> None:
        self.peer = peer
        self.raw = frame
        self.transaction, self.unit, self.pdu = parts
        self.reply = b""
        """Returns the PDU of a correct reply."""

    def frame(
        self, pdu: bytes | None = None, *, unit: int | None = None, transaction: int | None = None
    ) -> bytes:
        """Builds a frame of the transport; by default a correct reply."""
        return self.peer.framing.frame(
            self.reply if pdu is None else pdu,
            self.unit if unit is None else unit,
            self.transaction if transaction is None else transaction,
        )

    def answer(self, pdu: bytes | None = None, **header: int) -> None:
        """Sends a frame, with the same arguments as `frame`."""
        self.send(self.frame(pdu, **header))

    def send(self, *pieces: bytes) -> None:
        for piece in pieces:
            self.peer.send(piece)

    def end_with(self, data: bytes | None) -> None:
        """Sends bytes; `None` sends nothing, `HANG_UP` closes the connection."""
        if data == HANG_UP:
            self.peer.hang_up()
        elif data is not None:
            self.send(data)

    def drip(self, data: bytes) -> None:
        """Sends bytes one by one."""
        self.send(*[bytes([byte]) for byte in data])


class Framing(ABC):
    """How requests are split from received bytes, and how replies are framed."""

    @abstractmethod
    def frame(self, pdu: bytes, unit: int, transaction: int) -> bytes:
        """Builds a frame."""

    @abstractmethod
    def cut(self, received: bytes) -> tuple[int, tuple[int, int, bytes]] | None:
        """Parses the first request: its length, transaction id, unit id and PDU."""


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
    """RTU or ASCII framing, on a line or over TCP."""

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
    """Returns the length of the RTU request at the start of some bytes."""
    if len(received) < 2:
        return None
    code = received[1]
    counted = {15: 6, 16: 6, 20: 2, 21: 2, 23: 10}.get(code)
    if counted is None:
        return {7: 4, 11: 4, 12: 4, 17: 4, 22: 10, 24: 6, 43: 7}.get(code, 8)
    return None if len(received) <= counted else counted + 3 + received[counted]


class Peer:
    """The requesting side: a connection, an address, or the other end of a line."""

    def __init__(self, framing: Framing) -> None:
        self.framing = framing
        self.received = b""

    def send(self, data: bytes) -> None:
        raise NotImplementedError

    def hang_up(self) -> None:
        """Closes the connection at once, and drops unread requests."""
        raise NotImplementedError


class Connection(Peer):
    def __init__(self, framing: Framing, made: socket.socket) -> None:
        super().__init__(framing)
        self.socket = made
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        # The client may have disconnected.
        with contextlib.suppress(OSError):
            self.socket.sendall(data)

    def hang_up(self) -> None:
        self.received = b""
        self.socket.close()

    def close(self) -> None:
        """Closes it cleanly."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def reset(self) -> None:
        """Closes it with RST."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()


class Sender(Peer):
    """The sender of a datagram."""

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
    """Answers correctly."""
    asked.answer()


def silent(asked: Asked) -> None:
    """Does nothing."""


class Late:
    """Answers each request when the next one has come."""

    def __init__(self) -> None:
        self._held: Asked | None = None

    def __call__(self, asked: Asked) -> None:
        held, self._held = self._held, asked
        if held is not None:
            held.answer()


class ScriptedDevice(ABC):
    """A device that runs from `start` to `stop`, any number of times. One thread serves all
    connections, so none is left after `stop`.

    Each request is handled by the next entry of `script`, and by `then` after its end.
    """

    url: str
    is_modelled = True
    """Whether a model of a device computes the correct reply to every request."""

    def __init__(self, *script: Behaviour, then: Behaviour = good) -> None:
        self.script = list(script)
        self.then = then
        self.model = good_unit()
        self.requests: list[Asked] = []
        """All received requests, in order."""
        self.connections = 0
        self._end = 0
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def start(self) -> None:
        self.open()
        ended, self._end = os.pipe()
        self._thread = threading.Thread(target=self._serve, args=(ended,), name="fake device")
        self._thread.start()

    def stop(self) -> None:
        """Closes all connections and stops listening."""
        if self._thread is not None:
            os.close(self._end)
            self._thread.join()
            self._thread = None
            self.release()

    def await_requests(self, count: int) -> None:
        """Waits until exactly `count` requests have arrived."""
        wire.until(lambda: len(self.requests) >= count, f"{count} requests have come")
        assert len(self.requests) == count

    def open(self) -> None:  # noqa: B027 - most acquire them in the constructor
        """Acquires the resources that `release` has released."""

    @abstractmethod
    def sources(self) -> list[Any]:
        """Returns what can be read."""

    @abstractmethod
    def read(self, source: Any) -> Peer | None:
        """Reads, and returns the senders of new bytes."""

    @abstractmethod
    def release(self) -> None:
        """Releases all resources."""

    def _serve(self, ended: int) -> None:
        with os.fdopen(ended, "rb", buffering=0):
            self._deal_with_all(ended)

    def _deal_with_all(self, ended: int) -> None:
        while True:
            ready, _, _ = select.select([ended, *self.sources()], [], [])
            if ended in ready:
                return
            for source in ready:
                peer = self.read(source)
                while peer is not None and (found := peer.framing.cut(peer.received)):
                    end, parts = found
                    asked = Asked(peer, peer.received[:end], parts)
                    peer.received = peer.received[end:]
                    self._deal_with(asked)

    def _deal_with(self, asked: Asked) -> None:
        if self.is_modelled:
            asked.reply = self.model.answer(asked.unit, asked.pdu) or b""
        number = len(self.requests)
        self.requests.append(asked)
        behaviour = self.script[number] if number < len(self.script) else self.then
        behaviour(asked)


def framing_of(kind: str) -> Framing:
    """Returns the framing of a scheme."""
    frames = kind.partition("+")[0]
    return OnLine({"rtu": lines.RTU, "ascii": lines.ASCII}[frames]) if frames in LINES else Mbap()


class Stream(ScriptedDevice):
    """Over TCP, with MBAP, RTU or ASCII frames.

    Calls `greet` with each connection first. With `deaf`, reads nothing. With `in_turn`, accepts a
    connection when the previous one has ended. With `port`, listens only from `start` on.
    """

    def __init__(
        self,
        kind: str,
        *script: Behaviour,
        then: Behaviour = good,
        greet: Callable[[Connection, int], object] = lambda *_: None,
        deaf: bool = False,
        in_turn: bool = False,
        port: int | None = None,
    ) -> None:
        super().__init__(*script, then=then)
        self._framing = framing_of(kind)
        self._greet = greet
        self._deaf = deaf
        self._in_turn = in_turn
        self._peers: list[Connection] = []
        self._listener: socket.socket | None = None
        if port is None:
            self._listener = socket.create_server(("127.0.0.1", 0))
            port = self._listener.getsockname()[1]
        self.port: int = port
        self.url = f"{kind}://127.0.0.1:{self.port}"

    @property
    def is_connected(self) -> bool:
        """Whether a connection is open on this side."""
        return any(peer.socket.fileno() >= 0 for peer in self._peers)

    def open(self) -> None:
        if self._listener is None:
            self._listener = socket.create_server(("127.0.0.1", self.port))

    def sources(self) -> list[Any]:
        self._peers = [peer for peer in self._peers if peer.socket.fileno() >= 0]
        sockets = [] if self._deaf else [peer.socket for peer in self._peers]
        return sockets if self._in_turn and self._peers else [self._listener, *sockets]

    def read(self, source: Any) -> Peer | None:
        if self._listener is not None and source is self._listener:
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
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        for peer in self._peers:
            peer.socket.close()


class FakeDevice(Stream):
    """Answers requests with a function of their PDUs, one connection after the other."""

    is_modelled = False

    def __init__(self, answer: Answer) -> None:
        super().__init__("tcp", then=self._reply, in_turn=True)
        self.answer = answer

    @property
    def asked(self) -> list[bytes]:
        """The PDUs of all requests."""
        return [request.pdu for request in self.requests]

    def _reply(self, asked: Asked) -> None:
        pdu = self.answer(asked.pdu)
        asked.end_with(asked.frame(pdu) if pdu else pdu)


class Udp(ScriptedDevice):
    """Over UDP, with MBAP or RTU frames."""

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


FAST = {"parity": "none", "baud": 4_000_000}
"""A pseudo-terminal carries bytes at once: clients doubt replies faster than their line."""


class Serial(ScriptedDevice):
    """On a serial line."""

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
        query = "&".join(f"{key}={value}" for key, value in {**FAST, **options}.items())
        self.url = f"{mode.name}://{device}?{query}"

    def sources(self) -> list[Any]:
        return [self.terminal.end]

    def read(self, source: Any) -> Peer:  # noqa: ARG002
        # There may be no reader.
        with contextlib.suppress(OSError):
            self._peer.received += os.read(self.terminal.end, 65536)
        return self._peer

    def release(self) -> None:
        self.terminal.close()
