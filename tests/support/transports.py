"""Modbus over UDP, RTU over TCP and UDP, ASCII over TCP: simple clients as in `wire`, and
appliances with one listener.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.types import AREAS
from support import lines, wire
from support.config_folder import written
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import TracebackType
    from typing import Self

TYPES = {
    "tcp": "modbus-tcp",
    "udp": "modbus-udp",
    "rtu": "modbus-rtu-over-tcp",
    "rtu-udp": "modbus-rtu-over-udp",
    "ascii": "modbus-ascii-over-tcp",
}
"""The listener types by the names in tests."""

ALL: dict[str, Any] = dict.fromkeys(AREAS, 1000)
"""Every area with the addresses 0 to 999."""


def rule(sources: list[str], unit: int = 1, memory: str = "plant", **more: Any) -> dict[str, Any]:
    """Builds a rule for one unit id; by default with read and write access."""
    return {"sources": sources, "units": {unit: memory}, "access": "read-write", **more}


def configuration(
    kind: str,
    *,
    bind: str = "127.0.0.1:0",
    rules: list[dict[str, Any]] | None = None,
    memories: dict[str, Any] | None = None,
    more: dict[str, Any] | None = None,
    **listener: Any,
) -> str:
    """Builds a configuration with one listener, `scada`."""
    scada = {
        "type": TYPES[kind],
        "bind": bind,
        "rules": rules or [rule(["127.0.0.1", "::1"])],
        **listener,
    }
    return written(
        {"memories": memories or {"plant": ALL}, "listeners": {"scada": scada}, **(more or {})}
    )


@contextlib.contextmanager
def running(folder: Path, text: str) -> Iterator[Appliance]:
    """An appliance that several tests share."""
    file = folder / "appliance.yaml"
    file.write_text(text)
    with Appliance(load(file)) as started:
        yield started


def counters(appliance: Appliance) -> dict[str, Any]:
    """Returns the listener's counters."""
    counted: dict[str, Any] = appliance.diagnostics.stats()["listeners"]["scada"]
    return counted


def await_count(appliance: Appliance, group: str, key: str | int, number: int) -> None:
    """Waits until a counter reaches a number."""

    def count() -> int:
        counted: int = counters(appliance)[group].get(key, 0)
        return counted

    wire.until(lambda: count() >= number, f"{group}.{key} is {number}")
    assert count() == number


def address(appliance: Appliance) -> tuple[str, int]:
    return endpoint(appliance, "scada")


class Datagrams:
    """A UDP client of one server."""

    def __init__(self, to: tuple[str, int], *, source: str | None = None) -> None:
        family = socket.AF_INET6 if ":" in to[0] else socket.AF_INET
        self.socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            if source is not None:
                self.socket.bind((source, 0))
            self.socket.connect(to)
            self.socket.settimeout(wire.DEADLINE)
        except BaseException:
            self.socket.close()
            raise
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

    def send(self, datagram: bytes) -> None:
        self.socket.send(datagram)

    def receive(self) -> wire.Frame:
        """Returns the frame of the next datagram, which must contain exactly one."""
        datagram = self.socket.recv(65536)
        whole, left = wire.split(datagram)
        if len(whole) != 1 or left:
            raise AssertionError(f"not one frame: {datagram.hex()}")
        return whole[0]

    def ask(self, pdu: bytes, unit: int = 1) -> bytes:
        """Returns the PDU of the next reply, and checks its header against the request."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        self.send(wire.frame(pdu, unit, self._transaction))
        reply = self.receive()
        if (reply.transaction, reply.unit) != (self._transaction, unit):
            raise AssertionError(
                f"the header is not that of transaction {self._transaction}: {reply}"
            )
        return reply.pdu

    def replies(self, count: int) -> list[tuple[int, bytes]]:
        """Returns the unit ids and PDUs of the next `count` datagrams."""
        frames = [self.receive() for _ in range(count)]
        return [(frame.unit, frame.pdu) for frame in frames]

    def is_quiet(self) -> bool:
        """Returns whether no datagram has arrived."""
        return not select.select([self.socket], [], [], 0)[0]


class RtuDatagrams(Datagrams):
    """A UDP client of one server, with RTU frames."""

    def receive(self) -> wire.Frame:
        """Returns the frame of the next datagram, which must contain exactly one."""
        return wire.Frame(0, *lines.from_rtu(self.socket.recv(65536)))

    def ask(self, pdu: bytes, unit: int = 1) -> bytes:
        self.send(lines.rtu(pdu, unit))
        reply = self.receive()
        assert reply.unit == unit
        return reply.pdu


class FramedConnection(wire.Connection):
    """The frames of a serial line over one TCP connection."""

    mode: ClassVar[lines.Mode]

    def ask(self, pdu: bytes, unit: int = 1) -> bytes:
        self.send(self.mode.frame(pdu, unit))
        [(answered, reply)] = self.replies(1)
        assert answered == unit
        return reply

    def replies(self, count: int) -> list[tuple[int, bytes]]:
        """Returns the unit ids and PDUs of exactly `count` frames."""
        deadline = time.monotonic() + self.deadline
        got: list[tuple[int, bytes]] = []
        while len(got) < count:
            if (end := self.mode.length(self._received)) is not None:
                frame, self._received = self._received[:end], self._received[end:]
                got.append(self.mode.unframe(frame))
                continue
            patience = deadline - time.monotonic()
            if patience <= 0:
                raise TimeoutError(f"{len(got)} of {count} replies: {self._received.hex()}")
            self._receive(patience)
        return got

    def comes(self, seconds: float) -> bool:
        """Whether bytes come within this time, or have come."""
        return bool(self._received or select.select([self.socket], [], [], seconds)[0])

    def is_quiet(self) -> bool:
        """Returns whether no unread bytes have arrived."""
        return not self._received and not select.select([self.socket], [], [], 0)[0]


class RtuConnection(FramedConnection):
    """RTU frames over one TCP connection."""

    mode = lines.RTU


class AsciiConnection(FramedConnection):
    """ASCII frames over one TCP connection."""

    mode = lines.ASCII


Client = wire.Connection | Datagrams


@dataclass(frozen=True)
class Transport:
    """A transport of Modbus, for tests of one behaviour over several transports."""

    kind: str
    """The key in TYPES."""
    scheme: str
    """The scheme in URLs."""
    client: type[Client]
    mode: lines.Mode | None = None
    """The framing of a serial line; without one, frames have an MBAP header."""
    patient: dict[str, Any] = field(default_factory=dict)
    """Listener options with which, on a slow machine too, pieces of a request belong together."""

    def frame(self, pdu: bytes, unit: int = 1, transaction: int = 0) -> bytes:
        """Builds a frame. The transaction id is ignored where frames have none."""
        if self.mode is None:
            return wire.frame(pdu, unit, transaction)
        return self.mode.frame(pdu, unit)


TRANSPORTS = {
    transport.kind: transport
    for transport in (
        Transport("tcp", "tcp", wire.Connection),
        Transport("udp", "udp", Datagrams),
        Transport(
            "rtu",
            "rtu+tcp",
            RtuConnection,
            lines.RTU,
            {"frame_timeout": wire.DEADLINE, "request_timeout": wire.DEADLINE},
        ),
        Transport("rtu-udp", "rtu+udp", RtuDatagrams, lines.RTU),
        Transport("ascii", "ascii+tcp", AsciiConnection, lines.ASCII),
    )
}

NOT_OF_THEIR_LENGTH = {
    "PDU too short",
    "PDU too long",
    "FC16 quantity 124",
    "FC23 write quantity 122",
}
"""The PDU vectors that RTU over TCP can not carry: there, the function and the byte count say how
long a frame is, and these PDUs have another length."""


def client(kind: str, to: tuple[str, int], source: str | None = None) -> Client:
    """Creates a client of a transport; the caller closes it."""
    return TRANSPORTS[kind].client(to, source=source)


def is_stranger(kind: str, appliance: Appliance, to: tuple[str, int], source: str | None) -> bool:
    """Returns whether a peer gets no reply and is counted as not allowed by any rule."""
    request = bytes.fromhex("0300000001")
    refused = counters(appliance)["connections"]["refused_source"]
    with client(kind, to, source) as stranger:
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            stranger.send(TRANSPORTS[kind].frame(request))
        await_count(appliance, "connections", "refused_source", refused + 1)
        return stranger.is_quiet() if isinstance(stranger, Datagrams) else stranger.rest() == b""
