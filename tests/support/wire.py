"""A raw Modbus TCP client, independent of the library.

It sends bytes as given and returns whole frames. It checks only the framing. Every wait has a
deadline, so a silent server fails a test instead of blocking it.
"""

from __future__ import annotations

import contextlib
import itertools
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from types import TracebackType
    from typing import Self

DEADLINE = 60.0
"""Seconds to wait for a condition. Generous: only a failing test waits that long, and on a loaded
machine a process can be without a processor for seconds."""

MAX_PDU = 253


class Frame(NamedTuple):
    """A received frame."""

    transaction: int
    unit: int
    pdu: bytes


def frame(
    pdu: bytes,
    unit: int = 1,
    transaction: int = 0,
    *,
    protocol: int = 0,
    length: int | None = None,
) -> bytes:
    """Builds an MBAP header and a PDU; `length` overrides the length field."""
    told = len(pdu) + 1 if length is None else length
    return struct.pack(">HHHB", transaction, protocol, told, unit) + pdu


def frames(pdus: Iterable[bytes], unit: int = 1) -> bytes:
    """Builds consecutive frames with the transaction ids 0, 1, 2…"""
    return b"".join(frame(pdu, unit, index & 0xFFFF) for index, pdu in enumerate(pdus))


def split(received: bytes) -> tuple[list[Frame], bytes]:
    """Splits bytes into whole frames and the rest."""
    whole, at = [], 0
    while len(received) - at >= 7:
        transaction, protocol, length, unit = struct.unpack_from(">HHHB", received, at)
        if protocol != 0 or not 2 <= length <= MAX_PDU + 1:
            raise AssertionError(f"not a Modbus frame: {received[at : at + 16].hex()}…")
        end = at + 6 + length
        if end > len(received):
            break
        whole.append(Frame(transaction, unit, received[at + 7 : end]))
        at = end
    return whole, received[at:]


def until(condition: Callable[[], object], what: str, seconds: float = DEADLINE) -> None:
    """Waits until the condition holds; fails after the deadline."""
    start = time.monotonic()
    between_looks = threading.Event()
    while not condition():
        waited = time.monotonic() - start
        if waited > seconds:
            raise AssertionError(f"not within {seconds} s: {what}")
        between_looks.wait(min(0.002 + waited / 50, 0.01))


def until_long_enough(
    condition: Callable[[float], object], what: str, seconds: float = 0.1
) -> None:
    """Calls the condition with a time to wait for, until it holds; each has twice the time.

    It is for what must happen before a timeout ends that the test waits for. A loaded machine may
    need longer, any other one does not wait that long.
    """
    while not condition(seconds):
        if seconds > DEADLINE / 8:
            raise AssertionError(f"not within {seconds:g} s: {what}")
        seconds *= 2


def until_taken(client: socket.socket) -> None:
    """Waits until the peer on this machine has read all that was sent, where Linux tells (IPv4)."""
    if sys.platform != "linux":
        return
    ends = client.getpeername(), client.getsockname()
    ports = struct.pack(">HH", *(port for _, port in ends))
    hosts = b"".join(socket.inet_aton(host).ljust(16, b"\0") for host, _ in ends)
    # sock_diag(7): struct inet_diag_req_v2 for the peer's socket, with any interface and cookie.
    request = struct.pack("=BBBBI", socket.AF_INET, socket.IPPROTO_TCP, 0, 0, 0xFFFFFFFF)
    request += ports + hosts + struct.pack("=III", 0, 0xFFFFFFFF, 0xFFFFFFFF)
    by_family, is_request, is_error, rqueue = 20, 1, 2, 16 + 56
    header = struct.pack("=IHHII", 16 + len(request), by_family, is_request, 0, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 4) as sock_diag:
        sock_diag.settimeout(DEADLINE)

        def taken() -> bool:
            sock_diag.send(header + request)
            reply = sock_diag.recv(4096)
            is_gone = struct.unpack_from("=H", reply, 4) == (is_error,)
            return is_gone or struct.unpack_from("=I", reply, rqueue) == (0,)

        until(taken, "the peer has read what was sent")


class Connection:
    """A TCP connection to a server."""

    def __init__(
        self,
        address: tuple[str, int],
        *,
        source: str | None = None,
        receive_buffer: int | None = None,
        deadline: float = DEADLINE,
    ) -> None:
        self.deadline = deadline
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self.socket = socket.socket(family, socket.SOCK_STREAM)
        try:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if receive_buffer is not None:
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
            if source is not None:
                self.socket.bind((source, 0))
            self.socket.settimeout(deadline)
            self.socket.connect(address)
        except BaseException:
            self.socket.close()
            raise
        self._received = b""
        self._transaction = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        self.socket.close()

    def reset(self) -> None:
        """Closes the connection with RST instead of FIN."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()

    def finish(self) -> None:
        """Half-closes the connection."""
        self.socket.shutdown(socket.SHUT_WR)

    def send(self, data: bytes) -> None:
        self.socket.settimeout(self.deadline)
        self.socket.sendall(data)

    def ask(self, pdu: bytes, unit: int = 1) -> bytes:
        """Sends one request. Returns the PDU of the reply, and checks its header."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        self.send(frame(pdu, unit, self._transaction))
        reply = self.receive()
        if (reply.transaction, reply.unit) != (self._transaction, unit):
            raise AssertionError(
                f"the header is not that of transaction {self._transaction}: {reply}"
            )
        return reply.pdu

    def ask_many(self, pdus: Iterable[bytes], unit: int = 1) -> list[bytes]:
        """Sends pipelined requests. Returns the PDUs of the replies, which must be in order."""
        asked = list(pdus)
        replies = self.converse(frames(asked, unit), len(asked))
        order = [(reply.transaction, reply.unit) for reply in replies]
        if order != [(index & 0xFFFF, unit) for index in range(len(asked))]:
            raise AssertionError("the replies are not in the order of the requests")
        return [reply.pdu for reply in replies]

    def receive(self) -> Frame:
        """Returns the next frame."""
        return self.receive_many(1)[0]

    def receive_many(self, count: int) -> list[Frame]:
        """Returns exactly `count` frames; keeps further ones."""
        return self.converse(b"", count)

    def converse(self, data: bytes, count: int) -> list[Frame]:
        """Sends and receives concurrently, so that full buffers can't block either side."""
        deadline = time.monotonic() + self.deadline
        unsent = memoryview(data)
        got: list[Frame] = []
        while True:
            whole, self._received = split(self._received)
            got += whole
            if len(got) >= count and not unsent:
                self._keep(got[count:])
                return got[:count]
            patience = deadline - time.monotonic()
            if patience <= 0:
                raise TimeoutError(f"{len(got)} of {count} replies within {self.deadline} s")
            if not unsent:
                self._receive(patience)
                continue
            self.socket.setblocking(False)
            readable, writable, _ = select.select([self.socket], [self.socket], [], patience)
            if writable:
                unsent = unsent[self.socket.send(unsent[:65536]) :]
            if readable:
                self._receive(patience)

    def _receive(self, patience: float) -> None:
        self.socket.settimeout(patience)
        with contextlib.suppress(TimeoutError):
            piece = self.socket.recv(262144)
            if not piece:
                raise ConnectionError("closed before all replies have come")
            self._received += piece

    def _keep(self, more: list[Frame]) -> None:
        kept = b"".join(frame(pdu, unit, transaction) for transaction, unit, pdu in more)
        self._received = kept + self._received

    def rest(self) -> bytes:
        """Returns all bytes until the end of the connection. Each piece must come in time."""
        pieces, self._received = [self._received], b""
        while True:
            self.socket.settimeout(self.deadline)
            try:
                piece = self.socket.recv(65536)
            except TimeoutError:
                raise AssertionError(f"still open after {self.deadline} s") from None
            except (ConnectionResetError, BrokenPipeError):
                piece = b""
            if not piece:
                return b"".join(pieces)
            pieces.append(piece)


def rounds(enough: threading.Event, least: int = 1) -> Iterator[int]:
    """Counts rounds until there are enough, because threads of a slow machine meet later."""
    deadline = time.monotonic() + 2 * DEADLINE
    for number in itertools.count():
        if number >= least and enough.is_set():
            return
        if time.monotonic() > deadline:
            raise AssertionError(f"the threads did not meet in {number} rounds")
        yield number


@contextlib.contextmanager
def dead_address() -> Iterator[tuple[str, int]]:
    """A TCP address that does not answer: the queue of its listening socket is full."""
    with contextlib.ExitStack() as opened:
        listening = opened.enter_context(socket.socket())
        listening.bind(("127.0.0.1", 0))
        listening.listen(0)
        while True:
            waiting = opened.enter_context(socket.socket())
            waiting.settimeout(0.2)
            try:
                waiting.connect(listening.getsockname())
            except TimeoutError:
                break
        yield listening.getsockname()
