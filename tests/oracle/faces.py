"""The ways into an appliance: one class for each. Only `LibraryFace` uses our own client, because a
fault of it could hide one of the server.

A face carries out one request at a time. `Lost` is raised if the reply does not come: the request
may have been carried out, or may still be. After that, the face connects again.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import struct
import zlib
from abc import ABC, abstractmethod
from http.client import HTTPConnection, HTTPException
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import urlencode

import holdfast
from oracle.history import Outcome
from oracle.requests import Lost, Reply, Request, Surprise, is_passed, stretch
from support import lines, wire
from support.server_model import pack_bits, pack_registers, unpack_bits, unpack_registers
from support.tls_peer import Peer, Refused
from support.transports import AsciiConnection, Datagrams, RtuConnection

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Mapping

    from holdfast.types import Area
    from oracle.layout import Range

    Address = tuple[str, int]
    Locate = Callable[[], Address]

UNITS = {"plant": 1, "annex": 2, "device": 9}
"""The unit ids of the memories, and of the device behind a route."""

MEMORY_ID = 7
"""The id of the memory `plant` in Raw Ingest packets of format crc."""

SEALED = "plant"
"""The memory that has a seal."""

READ = {"coils": 1, "discrete_inputs": 2, "holding_registers": 3, "input_registers": 4}
BITS = ("coils", "discrete_inputs")
RAW_AREAS: dict[Area, int] = {
    "coils": 1,
    "discrete_inputs": 2,
    "holding_registers": 3,
    "input_registers": 4,
}

BUSY = 6
REFUSALS = (1, 2)
"""Exceptions after which nothing has changed: function not allowed, address not allowed."""

DEVICE_REFUSAL = 4
"""The exception with which the device of the oracle refuses a write."""

NO_PATH = 0x0A
"""The exception of requests that were not sent to the device."""

NO_ANSWER = 0x0B
"""The exception of requests that were sent, and may have been carried out."""

TIMEOUT_S = wire.DEADLINE / 4
"""After this time, a reply is lost. Datagrams may be dropped by the system; nothing else is."""


class Traits:
    """What a face can do."""

    name: ClassVar[str]
    can_read = True
    can_batch = False
    """Whether a request can write blocks of several areas in one step."""
    spans_memories = False
    """Whether they can be in several memories."""
    can_cut = True
    """Whether the oracle can hang up within a request."""
    is_modbus = False
    areas: tuple[Area, ...] = ("coils", "discrete_inputs", "holding_registers", "input_registers")
    """Areas that it can write."""
    memories: tuple[str, ...] = ("plant", "annex")


class Face(Traits, ABC):
    """One client."""

    def __init__(self, locate: Locate) -> None:
        self._locate = locate

    @abstractmethod
    def connect(self) -> None:
        """Raises `OSError` if nobody listens."""

    @abstractmethod
    def carry_out(self, request: Request) -> Reply:
        """Raises `Lost` if there is no reply."""

    @abstractmethod
    def close(self) -> None:
        """Ends the connection."""

    def send_only(self, request: Request, part: float) -> None:
        """Sends a request, or with `part` below 1 the beginning of it, and ends the connection."""
        raise NotImplementedError


def pdu_of(request: Request) -> bytes:
    """The PDU of a request."""
    if not request.writes:
        [(_, area, address, count)] = request.reads
        return struct.pack(">BHH", READ[area], address, count)
    if request.is_mask:
        return struct.pack(">BHHH", 22, *request.mask())
    (_, area, address, count), items = request.stretch()
    if area in BITS:
        if request.is_single:
            return struct.pack(">BHH", 5, address, 0xFF00 * items[0])
        packed = pack_bits(items)
        return struct.pack(">BHHB", 15, address, count, len(packed)) + packed
    if request.is_single:
        return struct.pack(">BHH", 6, address, items[0])
    packed = pack_registers(items)
    if request.reads:
        [read] = request.reads
        head = struct.pack(">BHH", 23, read.address, read.size)
        return head + struct.pack(">HHB", address, count, len(packed)) + packed
    return struct.pack(">BHHB", 16, address, count, len(packed)) + packed


def reply_of(request: Request, sent: bytes, received: bytes) -> Reply:
    """What a reply says."""
    is_sealed_memory = request.memory == SEALED
    if received[0] == sent[0] | 0x80 and len(received) == 2:
        return _refusal(request, received[1])
    is_open = True if is_sealed_memory else None
    if not request.reads:
        expected = sent if sent[0] in (5, 6, 22) else sent[:5]
        if received != expected:
            raise Surprise(f"{received.hex()} to {sent.hex()}")
        return Reply(Outcome.DONE, (), is_open)
    [read] = request.reads
    data = received[2:]
    size = (read.size + 7) // 8 if read.area in BITS else 2 * read.size
    if received[:2] != bytes([sent[0], size]) or len(data) != size:
        raise Surprise(f"{received.hex()} to {sent.hex()}")
    if read.area in BITS:
        return Reply(Outcome.DONE, (tuple(unpack_bits(data, read.size)),), is_open)
    return Reply(Outcome.DONE, (tuple(unpack_registers(data)),), is_open)


def _refusal(request: Request, code: int) -> Reply:
    if code == BUSY and request.memory == SEALED:
        return Reply(Outcome.REFUSED, (), is_open=False)
    is_for_device = request.memory == "device" or is_passed([each.block for each in request.writes])
    if is_for_device and code == NO_ANSWER:
        return Reply(Outcome.UNKNOWN)
    if code in REFUSALS or (is_for_device and code in (BUSY, NO_PATH, DEVICE_REFUSAL)):
        return Reply(Outcome.REFUSED)
    raise Surprise(f"exception {code:#04x} to {request}")


class ModbusFace(Face):
    """Requests as PDUs, over a connection that the oracle frames itself."""

    is_modbus = True
    areas = ("coils", "holding_registers")
    memories = ("plant", "annex", "device")
    _connection: wire.Connection | Datagrams | Peer | None = None

    def connect(self) -> None:
        self._connection = self._open(self._locate())

    @abstractmethod
    def _open(self, address: Address) -> Any:
        """Opens a connection with a method `ask`."""

    def carry_out(self, request: Request) -> Reply:
        pdu = pdu_of(request)
        assert self._connection is not None
        try:
            received = self._connection.ask(pdu, UNITS[request.memory])
        except (OSError, Refused) as error:
            raise Lost(str(error)) from None
        return reply_of(request, pdu, received)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.__exit__(None, None, None)
            self._connection = None

    def send_only(self, request: Request, part: float) -> None:
        frame = self._frame(pdu_of(request), UNITS[request.memory])
        with contextlib.suppress(OSError):
            self._send(frame[: _length(frame, part)])
        self.close()

    def _frame(self, pdu: bytes, unit: int) -> bytes:
        return wire.frame(pdu, unit, 0xCC)

    def _send(self, data: bytes) -> None:
        assert isinstance(self._connection, wire.Connection | Datagrams)
        self._connection.send(data)


def _length(frame: bytes, part: float) -> int:
    """How many bytes of a frame are sent: all, or at least one and not all."""
    return len(frame) if part >= 1 else min(max(int(len(frame) * part), 1), len(frame) - 1)


class TcpFace(ModbusFace):
    name = "tcp"

    def _open(self, address: Address) -> wire.Connection:
        return wire.Connection(address, deadline=TIMEOUT_S)


class GuestFace(TcpFace):
    """The same, of a listener that comes and goes."""

    name = "tcp guest"


class RtuFace(ModbusFace):
    name = "rtu over tcp"

    def _open(self, address: Address) -> RtuConnection:
        return RtuConnection(address, deadline=TIMEOUT_S)

    def _frame(self, pdu: bytes, unit: int) -> bytes:
        return lines.rtu(pdu, unit)


class AsciiFace(ModbusFace):
    name = "ascii over tcp"

    def _open(self, address: Address) -> AsciiConnection:
        return AsciiConnection(address, deadline=TIMEOUT_S)

    def _frame(self, pdu: bytes, unit: int) -> bytes:
        return lines.ascii_frame(pdu, unit)


class UdpFace(ModbusFace):
    """A lost reply ends the socket, so that a late one is no reply to a later request."""

    name = "udp"

    def _open(self, address: Address) -> Datagrams:
        made = Datagrams(address)
        made.socket.settimeout(TIMEOUT_S)
        return made


class TlsFace(ModbusFace):
    name = "tls"

    def __init__(self, locate: Locate, trust: ssl.SSLContext) -> None:
        super().__init__(locate)
        self._trust = trust

    def _open(self, address: Address) -> Peer:
        made = Peer(address, self._trust)
        made.wire.deadline = TIMEOUT_S
        try:
            return made.shake()
        except (Refused, OSError) as error:
            made.wire.close()
            raise ConnectionError(str(error)) from None

    def _send(self, data: bytes) -> None:
        assert isinstance(self._connection, Peer)
        self._connection.send(data)


class LibraryFace(Face):
    """`holdfast.SyncClient`."""

    name = "library"
    is_modbus = True
    can_cut = False
    areas = ("coils", "holding_registers")
    _client: holdfast.SyncClient | None = None

    def connect(self) -> None:
        host, port = self._locate()
        self._client = holdfast.SyncClient(f"tcp://{host}:{port}", timeout=TIMEOUT_S)

    def carry_out(self, request: Request) -> Reply:
        try:
            values = self._call(request)
        except holdfast.ModbusException as error:
            return _refusal(request, error.code)
        except holdfast.ModbusError as error:
            raise Lost(str(error)) from None
        return Reply(Outcome.DONE, values, True if request.memory == SEALED else None)

    def _call(self, request: Request) -> tuple[tuple[int, ...], ...]:
        client, unit = self._client, UNITS[request.memory]
        assert client is not None
        if not request.writes:
            [(_, area, address, count)] = request.reads
            read = getattr(client, f"read_{area}")
            return (tuple(int(value) for value in read(address, count, unit=unit)),)
        if request.is_mask:
            address, and_mask, or_mask = request.mask()
            client.mask_write(address, and_mask=and_mask, or_mask=or_mask, unit=unit)
            return ()
        (_, area, address, _), items = request.stretch()
        if area in BITS:
            client.write_coils(address, [bool(item) for item in items], unit=unit)
            return ()
        if request.reads:
            [reads] = request.reads
            seen = client.read_write(reads.address, reads.size, address, items, unit=unit)
            return (tuple(seen),)
        client.write_registers(address, items, unit=unit)
        return ()

    def close(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


def command(request_range: Range, items: list[int]) -> dict[str, Any]:
    """A command of REST and MQTT."""
    memory, area, address, _ = request_range
    return {"memory": memory, "area": area, "address": address, "values": items}


def commands(request: Request) -> list[dict[str, Any]]:
    """One command if all blocks lie next to each other, otherwise one for each."""
    blocks = [write.block for write in request.writes]
    if all(before.is_followed_by(after) for before, after in itertools.pairwise(blocks)):
        return [command(*request.stretch())]
    return [command(*stretch([write])) for write in request.writes]


class RestFace(Face):
    name = "rest"
    can_batch = True
    spans_memories = True
    _connection: HTTPConnection | None = None

    def connect(self) -> None:
        host, port = self._locate()
        self._connection = HTTPConnection(host, port, timeout=TIMEOUT_S)
        self._connection.connect()
        assert self._connection.sock is not None
        self._connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A connection that has ended must not be opened again behind the back of the recorder.
        self._connection.auto_open = 0

    def carry_out(self, request: Request) -> Reply:
        if not request.writes:
            return self._read(request.reads[0])
        asked = commands(request)
        body = json.dumps(asked[0] if len(asked) == 1 else asked)
        status, reply = self._ask("POST", "/api/v1/ingest", body)
        if status == 200 and reply["status"] == "accepted":
            return Reply(Outcome.DONE)
        return _rejected(request, reply)

    def _read(self, read: Range) -> Reply:
        query = dict(zip(("memory", "area", "address", "count"), read, strict=True))
        status, reply = self._ask("GET", f"/api/v1/memory/read?{urlencode(query)}")
        if status != 200:
            raise Surprise(f"{status} {reply} to a read of {read}")
        return Reply(Outcome.DONE, (tuple(reply["values"]),))

    def _ask(self, method: str, path: str, body: str | None = None) -> tuple[int, dict[str, Any]]:
        assert self._connection is not None
        try:
            self._connection.request(method, path, body, {"Content-Type": "application/json"})
            response = self._connection.getresponse()
            return response.status, json.loads(response.read())
        except (OSError, HTTPException) as error:
            raise Lost(repr(error)) from None

    def send_only(self, request: Request, part: float) -> None:
        asked = commands(request)
        body = json.dumps(asked[0] if len(asked) == 1 else asked)
        head = f"Host: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: {len(body)}"
        data = f"POST /api/v1/ingest HTTP/1.1\r\n{head}\r\n\r\n{body}".encode()
        # REST may have announced the end of the connection with its last reply.
        if self._connection is not None and self._connection.sock is not None:
            with contextlib.suppress(OSError):
                self._connection.sock.sendall(data[: _length(data, part)])
        self.close()

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def _rejected(request: Request, reply: Mapping[str, Any]) -> Reply:
    """A refusal of REST or MQTT."""
    if is_passed([write.block for write in request.writes]):
        # Withdrawn: REST has started again while the write waited.
        if reply.get("reason") in ("mirrored", "withdrawn"):
            return Reply(Outcome.REFUSED)
        if reply.get("reason") == "device_refused":
            # It does not say whether the device has answered.
            return Reply(Outcome.UNKNOWN)
    raise Surprise(f"{reply} to {request}")


class RawFace(Face):
    """Raw Ingest: each packet has a connection of its own, or with `packets: many` all have one."""

    can_read = False
    is_many = False

    def __init__(self, locate: Locate) -> None:
        super().__init__(locate)
        self._socket: socket.socket | None = None

    @abstractmethod
    def packet(self, to: Range, data: bytes) -> bytes:
        """The packet that writes a payload."""

    def connect(self) -> None:
        if self.is_many:
            self._dial()

    def _dial(self) -> socket.socket:
        self._socket = socket.create_connection(self._locate(), TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._socket

    def carry_out(self, request: Request) -> Reply:
        data = self._data(request)
        try:
            opened = self._socket or self._dial()
            opened.sendall(data)
            answer = opened.recv(1)
        except OSError as error:
            raise Lost(str(error)) from None
        if answer != b"\0" or not self.is_many:
            self.close()
        if not answer:
            raise Lost("the connection ended without a reply")
        if answer == b"\0":
            return Reply(Outcome.DONE)
        if is_passed([write.block for write in request.writes]):
            # Packets never go to a device.
            return Reply(Outcome.REFUSED)
        raise Surprise(f"a packet was refused: {request}")

    def send_only(self, request: Request, part: float) -> None:
        data = self._data(request)
        with contextlib.suppress(OSError):
            (self._socket or self._dial()).sendall(data[: _length(data, part)])
        self.close()

    def _data(self, request: Request) -> bytes:
        to, items = request.stretch()
        return self.packet(to, (pack_bits if to.area in BITS else pack_registers)(items))

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class RawV1Face(RawFace):
    name = "raw v1"

    def packet(self, to: Range, data: bytes) -> bytes:
        unit = UNITS[to.memory]
        header = struct.pack(">2sBBHHH", b"RI", 1, RAW_AREAS[to.area], unit, to.address, to.size)
        return header + data


class RawCrcFace(RawFace):
    name = "raw crc"
    is_many = True
    memories = ("plant",)

    def packet(self, to: Range, data: bytes) -> bytes:
        head = struct.pack(">2sBBBBH", b"RI", 1, 0, RAW_AREAS[to.area], 0, MEMORY_ID)
        packet = head + struct.pack(">HH", to.address, to.size) + data
        return packet + struct.pack(">I", zlib.crc32(packet))


class PythonFace(Face):
    """A program that has the memories in its process."""

    name = "python"
    can_batch = True
    can_cut = False

    def __init__(self, memories: Mapping[str, holdfast.Memory]) -> None:
        super().__init__(lambda: ("", 0))
        self._memories = memories

    def connect(self) -> None:
        """There is nothing to connect to."""

    def carry_out(self, request: Request) -> Reply:
        memory = self._memories[request.memory]
        if not request.writes:
            seen = memory.read_many([(of.area, of.address, of.size) for of in request.reads])
            return Reply(Outcome.DONE, tuple(tuple(values) for values in seen))
        ranges = [stretch([write]) for write in request.writes]
        try:
            memory.write_many([(to.area, to.address, items) for to, items in ranges])
        except ValueError as error:
            if is_passed([write.block for write in request.writes]):
                return Reply(Outcome.REFUSED)
            raise Surprise(f"{error!r} to {request}") from None
        return Reply(Outcome.DONE)

    def close(self) -> None:
        """There is nothing to close."""


class MqttTraits(Traits):
    """What commands over MQTT can do; `MqttFace` publishes them."""

    name = "mqtt"
    can_read = False
    can_batch = True
    spans_memories = True
