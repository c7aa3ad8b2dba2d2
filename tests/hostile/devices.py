"""Devices that misbehave on purpose, on every transport.

A device executes requests correctly. What it sends, and when, is decided by its vice (`modes`).
The value of a register names its unit, function and address, and the number of the request that
read it, so whoever reads a value can tell which request it answers. A write is executed when its
confirmation is sent.

A device that was itself held up stays silent: its replies would be later than its vice says.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import random
import select
import socket
import struct
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from support import lines
from support.fake_device import Connection, Peer, Sender, Wire, framing_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    Vice = Callable[["Turn"], Iterable["Action"]]

UNITS = (1, 2)
COUNT = 2
"""Registers of each read."""

ADDRESSES = range(0, 16, COUNT)
WRITABLE = range(100, 108)
"""Registers that hold what was written."""

VERSIONS = 1 << 10
"""Versions of a value. Of two, the later one is at most half as many ahead."""

BAUD = 115200
CHARACTER = 10 / BAUD

TICK = 0.005
HELD_UP = 0.015
"""Seconds without a processor after which a device stays silent."""

REFUSED = 4
"""Every so many values, a device refuses to hold one: it is not written."""


def tag(unit: int, function: int, address: int) -> int:
    """The part of a value that names its register."""
    return ((unit - 1) << 5 | (function & 1) << 4 | address & 15) * VERSIONS


def accepts(value: int) -> bool:
    """Whether a device holds this value when it is written."""
    return value % REFUSED != 0


@dataclass(frozen=True)
class Action:
    """What a device does some seconds after a request."""

    after: float
    data: bytes | None
    """Bytes that it sends; `None` closes the connection."""
    executes: bool = False
    """Whether it executes the request just before."""


class Turn:
    """A request to a device, and the replies that it can send."""

    def __init__(
        self, device: Device, peer: Peer, raw: bytes, parts: tuple[int, int, bytes]
    ) -> None:
        self.device = device
        self.peer = peer
        self.raw = raw
        self.transaction, self.unit, self.pdu = parts
        self.number = device.received
        """The number of the request."""
        self.timeout = device.timeout
        self.random = device.random
        self.is_write = self.pdu[0] in (6, 16)
        self.answer = self._answer()
        self._read = None if self.is_write else struct.unpack(">HH", self.pdu[1:5])

    @property
    def address(self) -> int:
        return int.from_bytes(self.pdu[1:3])

    @property
    def written(self) -> tuple[int, int, int]:
        """The unit, the address and the value of a write of one register."""
        return self.unit, self.address, int.from_bytes(self.pdu[-2:])

    def frame(
        self, pdu: bytes | None = None, *, unit: int | None = None, transaction: int | None = None
    ) -> bytes:
        """Builds a frame of the transport; by default the correct reply."""
        return self.peer.framing.frame(
            self.answer if pdu is None else pdu,
            self.unit if unit is None else unit,
            self.transaction if transaction is None else transaction,
        )

    def reply(self, after: float = 0.0) -> Action:
        """The correct reply."""
        executes = self.is_write and accepts(self.written[2])
        return Action(after, self.frame(), executes)

    def exception(self, code: int) -> bytes:
        return self.frame(bytes([self.pdu[0] | 0x80, code]))

    def _answer(self) -> bytes:
        function = self.pdu[0]
        if self.is_write:
            if not accepts(self.written[2]):
                return bytes([function | 0x80, 4])
            return self.pdu if function == 6 else self.pdu[:5]
        address, count = struct.unpack(">HH", self.pdu[1:5])
        values = [self._value(function, address + index) for index in range(count)]
        return bytes([function, 2 * count]) + struct.pack(f">{count}H", *values)

    def _value(self, function: int, address: int) -> int:
        if address in WRITABLE:
            return self.device.held.get((self.unit, address), 0)
        return tag(self.unit, function, address) + self.number % VERSIONS


class Device:
    """A device with one vice. It runs while it is entered."""

    def __init__(self, kind: str, vice: Vice, timeout: float, folder: Path) -> None:
        self.kind = kind
        self.timeout = timeout
        """The timeout of its clients."""
        self.random = random.Random(7)
        self.received = 0
        """Requests so far."""
        self.executed: set[tuple[int, int, int]] = set()
        self.held: dict[tuple[int, int], int] = {}
        self.kept: list[bytes] = []
        """Replies that are not sent yet."""
        self.busy = 0.0
        """Until when replies are sent that take a while."""
        self.silences = 0
        """How often it stayed silent because it was held up."""
        self._vice = vice
        self._framing = framing_of(kind)
        self._due: list[tuple[float, int, Turn, Action]] = []
        self._numbers = itertools.count()
        self._peers: list[Any] = []
        self._terminal: lines.Terminal | None = None
        self._listener: socket.socket | None = None
        self.url = self._open(folder)
        self._end, self._ended = os.pipe()
        self._thread = threading.Thread(target=self._run, name="hostile device")

    @property
    def has_ids(self) -> bool:
        """Whether frames have transaction ids."""
        return self.kind in ("tcp", "udp")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._ended)
        self._thread.join()
        os.close(self._end)
        for peer in self._peers:
            if isinstance(peer, Connection):
                peer.socket.close()
        if self._listener is not None:
            self._listener.close()
        if self._terminal is not None:
            self._terminal.close()

    def _open(self, folder: Path) -> str:
        if self.kind in ("rtu", "ascii"):
            path = folder / f"line{id(self)}"
            self._terminal = lines.Terminal(path)
            self._peers.append(Wire(self._framing, self._terminal))
            return f"{self.kind}://{path}?parity=none&baud={BAUD}"
        if self.kind.endswith("udp"):
            self._listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._listener.bind(("127.0.0.1", 0))
        else:
            self._listener = socket.create_server(("127.0.0.1", 0))
        return f"{self.kind}://127.0.0.1:{self._listener.getsockname()[1]}"

    def _run(self) -> None:
        awake = time.monotonic()
        while True:
            wait = min(max(self._due[0][0] - awake, 0.0), TICK) if self._due else TICK
            ready, _, _ = select.select([self._end, *self._sources()], [], [], wait)
            if self._end in ready:
                return
            now = time.monotonic()
            is_held_up = now - awake > wait + HELD_UP
            if is_held_up:
                self._fall_silent()
            for source in ready:
                self._take(source, now, is_silent=is_held_up)
            self._act(now)
            awake = now

    def _sources(self) -> list[Any]:
        if self._terminal is not None:
            return [self._terminal.end]
        self._peers = [
            peer for peer in self._peers if isinstance(peer, Sender) or peer.socket.fileno() >= 0
        ]
        streams = [peer.socket for peer in self._peers if isinstance(peer, Connection)]
        return [self._listener, *streams]

    def _take(self, source: Any, now: float, *, is_silent: bool) -> None:
        """Reads from a source, and decides what happens to the requests."""
        peer = self._received(source)
        while peer is not None and (found := peer.framing.cut(peer.received)):
            end, parts = found
            raw, peer.received = peer.received[:end], peer.received[end:]
            self.received += 1
            turn = Turn(self, peer, raw, parts)
            if is_silent:
                continue
            # A serial line carries a request and its reply one character after the other.
            line = 0.0
            if self._terminal is not None:
                line = CHARACTER * (len(raw) + len(turn.frame()))
            for action in self._vice(turn):
                at = now + line + action.after
                heapq.heappush(self._due, (at, next(self._numbers), turn, action))

    def _received(self, source: Any) -> Peer | None:
        if self._terminal is not None:
            [line] = self._peers
            with contextlib.suppress(OSError):
                line.received += os.read(self._terminal.end, 65536)
            return line  # type: ignore[no-any-return]
        assert self._listener is not None
        if source is self._listener:
            return self._newcomer()
        [peer] = [peer for peer in self._peers if peer.socket is source]
        try:
            data = peer.socket.recv(65536)
        except OSError:
            data = b""
        if not data:
            peer.socket.close()
            return None
        peer.received += data
        return peer  # type: ignore[no-any-return]

    def _newcomer(self) -> Peer | None:
        assert self._listener is not None
        if self.kind.endswith("udp"):
            data, address = self._listener.recvfrom(65536)
            sender = Sender(self._framing, self._listener, address)
            sender.received = data
            self._peers = [sender]
            return sender
        made, _ = self._listener.accept()
        self._peers.append(Connection(self._framing, made))
        return None

    def _act(self, now: float) -> None:
        while self._due and self._due[0][0] <= now:
            if time.monotonic() > now + HELD_UP:
                self._fall_silent()
                return
            _, _, turn, action = heapq.heappop(self._due)
            if action.executes:
                self._execute(turn)
            peer = self._reachable(turn.peer)
            if peer is None:
                continue
            if action.data is None:
                if isinstance(peer, Connection):
                    peer.close()
                    peer.hang_up()
                continue
            with contextlib.suppress(OSError):
                peer.send(action.data)

    def _execute(self, turn: Turn) -> None:
        unit, address, value = turn.written
        self.executed.add(turn.written)
        self.held[unit, address] = value

    def _fall_silent(self) -> None:
        """Sends nothing of what is due. What was to be executed is."""
        self.silences += 1
        for _, _, turn, action in self._due:
            if action.executes:
                self._execute(turn)
        self._due.clear()
        self.kept.clear()

    def _reachable(self, peer: Peer) -> Peer | None:
        """The peer, or the newest one if its connection has ended: so does a gateway."""
        if isinstance(peer, Connection) and peer.socket.fileno() < 0:
            others = [each for each in self._peers if each.socket.fileno() >= 0]
            return others[-1] if others else None
        return self._peers[-1] if isinstance(peer, Sender) else peer


def other(pdu: bytes) -> bytes:
    """The PDU of a reply to a read of another address."""
    values = struct.unpack(f">{pdu[1] // 2}H", pdu[2:])
    elsewhere = [value ^ 8 * VERSIONS for value in values]
    return pdu[:2] + struct.pack(f">{len(values)}H", *elsewhere)
