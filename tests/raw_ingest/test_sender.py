"""Sending Raw Ingest packets: what is on the wire, and what is made of every kind of answer."""

from __future__ import annotations

import asyncio
import contextlib
import enum
import json
import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Protocol

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast import raw_ingest
from holdfast.types import AREAS
from support import wire
from support.paths import VECTORS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.types import Area

CASES = json.loads((VECTORS / "raw_ingest.json").read_text())
PACKET = raw_ingest.encode("holding_registers", 0, [1, 2], unit=1)
MAX_PACKET = raw_ingest.encode("holding_registers", 0, range(65535), unit=1)

# More than the socket buffers of both sides hold.
TOO_MUCH = bytes(64 << 20)


class Send(Protocol):
    """Sends a packet, async or sync."""

    def __call__(
        self, host: str, port: int, packet: bytes = ..., *, timeout: float = ...
    ) -> None: ...


def send_async(host: str, port: int, packet: bytes = PACKET, *, timeout: float = 10) -> None:
    asyncio.run(raw_ingest.send_packet(host, port, packet, timeout=timeout), debug=True)


def send_sync(host: str, port: int, packet: bytes = PACKET, *, timeout: float = 10) -> None:
    raw_ingest.send_packet_sync(host, port, packet, timeout=timeout)


@pytest.fixture(params=[send_async, send_sync], ids=["async", "sync"])
def send(request: pytest.FixtureRequest) -> Send:
    way: Send = request.param
    return way


class Receiver:
    """Takes connections, does with each what it was told, and then closes it."""

    def __init__(self, behave: Callable[[socket.socket], None], host: str = "127.0.0.1") -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.listening = socket.create_server((host, 0), family=family)
        self.host, self.port = self.listening.getsockname()[:2]
        self.ended = threading.Event()
        self._behave = behave
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection = self.listening.accept()[0]
                connection.settimeout(wire.DEADLINE)
                with connection:
                    self._behave(connection)
                self.ended.set()

    def stop(self) -> None:
        with contextlib.suppress(OSError):
            self.listening.shutdown(socket.SHUT_RDWR)
        self.listening.close()
        self._thread.join(wire.DEADLINE)
        assert not self._thread.is_alive()


class Receive(Protocol):
    def __call__(self, behave: Callable[[socket.socket], None], host: str = ...) -> Receiver: ...


@pytest.fixture
def receiver() -> Iterator[Receive]:
    with contextlib.ExitStack() as running:

        def start(behave: Callable[[socket.socket], None], host: str = "127.0.0.1") -> Receiver:
            started = Receiver(behave, host)
            running.callback(started.stop)
            return started

        yield start


def take(connection: socket.socket, size: int) -> bytes:
    taken = b""
    while len(taken) < size:
        piece = connection.recv(size - len(taken))
        assert piece, "ended early"
        taken += piece
    return taken


def answering(reply: bytes, size: int = len(PACKET)) -> Callable[[socket.socket], None]:
    """Takes a whole packet, then answers."""

    def behave(connection: socket.socket) -> None:
        take(connection, size)
        connection.sendall(reply)

    return behave


def until_it_ends(connection: socket.socket) -> None:
    with contextlib.suppress(ConnectionResetError):
        while connection.recv(1 << 20):
            pass


# Packets


def arguments(case: dict[str, Any], name: str) -> dict[str, Any]:
    """What makes the packet of a vector: its values, or its data where that has stray bits."""
    packet = bytes.fromhex(case[name])
    payload = packet[10:] if name == "v1" else packet[12:-4]
    target = {"unit": 1} if name == "v1" else {"memory_id": 1}
    if "stray" in case["name"]:
        count = int.from_bytes(packet[8:10] if name == "v1" else packet[10:12], "big")
        return {"data": payload, "count": count, **target}
    return {"values": case["values"], **target}


@pytest.mark.parametrize("name", ["v1", "crc"])
@pytest.mark.parametrize("case", CASES["accepted"], ids=lambda case: case["name"])
def test_packets_are_those_of_the_vectors(case: dict[str, Any], name: str) -> None:
    made = raw_ingest.encode(case["area"], case["address"], **arguments(case, name), format=name)  # type: ignore[arg-type]
    assert made.hex() == case[name]


def model_crc(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        for place in range(8):
            odd = (crc ^ byte >> place) & 1
            crc = crc >> 1 ^ (0xEDB88320 if odd else 0)
    return crc ^ 0xFFFFFFFF


def model(area: Area, address: int, values: list[int], target: int, name: str) -> bytes:
    """A packet, written down from the tables of docs/raw-ingest.md."""
    code = {"coils": 1, "discrete_inputs": 2, "holding_registers": 3, "input_registers": 4}[area]
    out = [0x52, 0x49, 0x01, code] if name == "v1" else [0x52, 0x49, 0x01, 0x00, code, 0x00]
    for field in (target, address, len(values)):
        out += divmod(field, 256)
    if code >= 3:
        for value in values:
            out += divmod(value, 256)
    else:
        for start in range(0, len(values), 8):
            eight = values[start : start + 8]
            out.append(sum(2**place for place, value in enumerate(eight) if value))
    crc = struct.pack(">I", model_crc(bytes(out))) if name == "crc" else b""
    return bytes(out) + crc


words = st.integers(0, 65535)


@st.composite
def writes(draw: st.DrawFn) -> tuple[Area, int, list[int]]:
    area = draw(st.sampled_from(AREAS))
    bits = area in AREAS[:2]
    values = draw(st.lists(st.integers(0, 1) if bits else words, min_size=1, max_size=300))
    return area, draw(st.integers(0, 65536 - len(values))), values


@given(writes(), words)
def test_packets_are_those_of_a_model(write: tuple[Area, int, list[int]], target: int) -> None:
    v1 = raw_ingest.encode(*write, unit=target)
    assert v1 == model(*write, target, "v1")
    crc = raw_ingest.encode(*write, memory_id=target)
    assert crc == model(*write, target, "crc")
    assert raw_ingest.encode(*write, memory_id=target, crc="none") == crc[:-4]
    area, address, values = write
    count = len(values) if area in AREAS[:2] else None
    assert raw_ingest.encode(area, address, data=v1[10:], count=count, unit=target) == v1


class Kind(enum.IntEnum):
    LAST = 65535


def test_values_may_come_as_any_integers_and_from_any_iterable() -> None:
    made = raw_ingest.encode("holding_registers", 0, (value for value in (Kind.LAST, 0)), unit=1)
    assert made[10:].hex() == "ffff0000"
    assert raw_ingest.encode("coils", 0, [True, False, 1], unit=1)[10:].hex() == "05"
    for data in (bytearray(b"\x01\x02"), memoryview(b"\x01\x02")):
        assert raw_ingest.encode("input_registers", 0, data=data, unit=1)[10:] == b"\x01\x02"


def test_a_packet_has_up_to_65535_values() -> None:
    assert len(MAX_PACKET) == 10 + 2 * 65535
    bits = raw_ingest.encode("coils", 1, [1] * 65535, memory_id=0)
    assert bits[12:-4] == b"\xff" * 8191 + b"\x7f"


WRONG: list[tuple[str, dict[str, Any], type[Exception], str]] = [
    ("an area", {"area": "coil"}, ValueError, "area is 'coil', allowed: coils, discrete"),
    ("a negative address", {"address": -1}, ValueError, "address is -1, allowed: 0 to 65535"),
    ("an address", {"address": 65536}, ValueError, "address is 65536, allowed: 0 to 65535"),
    ("an address as text", {"address": "1"}, TypeError, "address is '1', allowed: integers 0"),
    ("an address as truth", {"address": True}, TypeError, "address is True, allowed: integers"),
    ("the end", {"address": 65534}, ValueError, "holding_registers: 3 from address 65534, the l"),
    ("no values", {"values": []}, ValueError, "found 0 values, allowed: 1 to 65535"),
    ("many values", {"values": [0] * 65536}, ValueError, "found 65536 values, allowed: 1 to"),
    ("a value", {"values": [0, 65536]}, ValueError, "values[1] is 65536, allowed: integers 0"),
    ("a negative value", {"values": [-1]}, ValueError, "values[0] is -1, allowed: integers 0"),
    ("truth", {"values": [True]}, TypeError, "values[0] is True, allowed: integers 0 to 65535"),
    ("a float", {"values": [1.0]}, TypeError, "values[0] is 1.0, allowed: integers 0 to 65535"),
    ("text", {"values": ["1"]}, TypeError, "values[0] is '1', allowed: integers 0 to 65535"),
    ("nothing", {"values": [None]}, TypeError, "values[0] is None, allowed: integers 0"),
    ("a bit", {"area": "coils", "values": [2]}, ValueError, "values[0] is 2, allowed: 0, 1, F"),
    ("a bit of 1.0", {"area": "coils", "values": [1.0]}, TypeError, "values[0] is 1.0, allowed"),
    ("bytes as values", {"values": b"\0\1"}, TypeError, "values are bytes; pass them as data"),
    ("a mapping", {"values": {0: 5}}, TypeError, "values are dict, not a sequence of integers"),
    ("nothing at all", {"values": None}, TypeError, "a packet requires either values or data"),
    ("values and data", {"data": b"\0\1"}, TypeError, "a packet requires either values or data"),
    ("another count", {"count": 2}, ValueError, "count is 2, but found 3 values"),
    ("text as data", {"values": None, "data": "\0\1"}, TypeError, "data is '\\x00\\x01', not b"),
    ("odd data", {"values": None, "data": b"\0"}, ValueError, "data has 1 bytes, allowed: 2 f"),
    ("no data", {"values": None, "data": b""}, ValueError, "data has 0 bytes, allowed: 2 for"),
    (
        "much data",
        {"values": None, "data": bytes(131072)},
        ValueError,
        "data has 131072 bytes, allowed: 2 for each of 1 to 65535 registers",
    ),
    (
        "data of another count",
        {"values": None, "data": b"\0\1", "count": 2},
        ValueError,
        "count is 2, but data has 1 registers",
    ),
    (
        "bits without a count",
        {"area": "coils", "values": None, "data": b"\1"},
        TypeError,
        "data of bits requires a count",
    ),
    (
        "bits of another count",
        {"area": "coils", "values": None, "data": b"\1", "count": 9},
        ValueError,
        "9 coils require 2 bytes, data has 1",
    ),
    (
        "count 0",
        {"area": "coils", "values": None, "data": b"", "count": 0},
        ValueError,
        "count is 0, allowed: 1 to 65535",
    ),
    ("a unit", {"unit": 65536}, ValueError, "unit is 65536, allowed: 0 to 65535"),
    ("a unit as truth", {"unit": True}, TypeError, "unit is True, allowed: integers 0 to"),
    (
        "no target",
        {"unit": None},
        TypeError,
        "a packet requires either a unit (format v1) or a mem",
    ),
    ("both targets", {"memory_id": 1}, TypeError, "a packet requires either a unit (format v1) or"),
    ("a memory id", {"unit": None, "memory_id": -1}, ValueError, "memory_id is -1, allowed:"),
    ("the other format", {"format": "crc"}, ValueError, "format is 'crc', but the packet is of"),
    ("a CRC in v1", {"crc": "required"}, ValueError, "crc requires format crc: a packet of format"),
    ("another CRC", {"unit": None, "memory_id": 1, "crc": "no"}, ValueError, "crc is 'no', allow"),
]


@pytest.mark.parametrize(
    ("changes", "kind", "text"), [case[1:] for case in WRONG], ids=[case[0] for case in WRONG]
)
def test_what_no_receiver_may_accept_is_not_made(
    changes: dict[str, Any], kind: type[Exception], text: str
) -> None:
    right: dict[str, Any] = {
        "area": "holding_registers",
        "address": 0,
        "values": [1, 2, 3],
        "unit": 1,
    }
    with pytest.raises(kind) as raised:
        raw_ingest.encode(**(right | changes))
    assert str(raised.value).startswith(text)


# Answers


def test_a_packet_is_sent_and_the_connection_closed(send: Send, receiver: Receive) -> None:
    got: list[bytes] = []

    def behave(connection: socket.socket) -> None:
        got.append(take(connection, len(MAX_PACKET)))
        connection.sendall(b"\x00")
        got.append(connection.recv(1))

    there = receiver(behave)
    send(there.host, there.port, MAX_PACKET)
    wire.until(there.ended.is_set, "the connection is closed")
    assert got == [MAX_PACKET, b""]


@pytest.mark.parametrize("way", ["async", "sync"])
def test_values_are_sent_without_a_detour(way: str, receiver: Receive) -> None:
    got: list[bytes] = []

    def behave(connection: socket.socket) -> None:
        got.append(take(connection, 18))
        connection.sendall(b"\x00")

    there = receiver(behave)
    to = (there.host, there.port)
    if way == "async":
        asyncio.run(raw_ingest.send(*to, "input_registers", 7, [1], memory_id=3, timeout=10))
    else:
        raw_ingest.send_sync(*to, "input_registers", 7, [1], memory_id=3, timeout=10)
    assert got == [raw_ingest.encode("input_registers", 7, [1], memory_id=3)]


def test_a_refused_packet_raises(send: Send, receiver: Receive) -> None:
    there = receiver(answering(b"\x01"))
    with pytest.raises(raw_ingest.RawRefused) as raised:
        send(there.host, there.port)
    assert str(raised.value) == (f"127.0.0.1:{there.port} refused the packet; nothing was written")
    assert raised.value.maybe_written is False


def test_an_unknown_reply_raises(send: Send, receiver: Receive) -> None:
    there = receiver(answering(b"\x02"))
    with pytest.raises(raw_ingest.RawError, match="answered 02, allowed: 00 or 01; the packet may"):
        send(there.host, there.port)


def test_only_the_first_byte_of_a_reply_counts(send: Send, receiver: Receive) -> None:
    there = receiver(answering(b"\x00\x01garbage"))
    send(there.host, there.port)


def test_a_connection_closed_without_a_reply_raises(send: Send, receiver: Receive) -> None:
    there = receiver(answering(b""))
    with pytest.raises(
        raw_ingest.RawError, match="closed the connection without a reply"
    ) as raised:
        send(there.host, there.port)
    assert raised.value.maybe_written is True


def test_a_reset_raises(send: Send, receiver: Receive) -> None:
    def behave(connection: socket.socket) -> None:
        take(connection, len(PACKET))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    there = receiver(behave)
    with pytest.raises(
        raw_ingest.RawError, match="Connection reset by peer; the packet may"
    ) as raised:
        send(there.host, there.port)
    assert raised.value.maybe_written is True
    assert isinstance(raised.value.__cause__, ConnectionResetError)


def test_a_reset_in_the_middle_of_a_packet_has_written_nothing(
    send: Send, receiver: Receive
) -> None:
    def behave(connection: socket.socket) -> None:
        take(connection, 1000)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    there = receiver(behave)
    with pytest.raises(raw_ingest.RawError, match="; nothing was written") as raised:
        send(there.host, there.port, TOO_MUCH)
    assert raised.value.maybe_written is False


def test_silence_ends_with_the_deadline(send: Send, receiver: Receive) -> None:
    there = receiver(until_it_ends)
    began = time.monotonic()
    with pytest.raises(
        raw_ingest.RawTimeout, match=r"no reply within 0\.2 s; the packet may"
    ) as raised:
        send(there.host, there.port, timeout=0.2)
    assert 0.2 <= time.monotonic() - began < wire.DEADLINE
    assert isinstance(raised.value, TimeoutError)
    assert raised.value.maybe_written is True
    wire.until(there.ended.is_set, "the connection is closed")


def test_a_receiver_that_takes_nothing_ends_with_the_deadline(
    send: Send, receiver: Receive
) -> None:
    over = threading.Event()

    def behave(connection: socket.socket) -> None:  # noqa: ARG001
        over.wait(wire.DEADLINE)

    there = receiver(behave)
    with pytest.raises(raw_ingest.RawTimeout, match="nothing was written") as raised:
        send(there.host, there.port, TOO_MUCH, timeout=0.2)
    over.set()
    assert raised.value.maybe_written is False


def test_a_receiver_that_takes_packets_slowly_has_the_same_deadline(
    send: Send, receiver: Receive
) -> None:
    over = threading.Event()

    def behave(connection: socket.socket) -> None:
        with contextlib.suppress(ConnectionError):
            while connection.recv(65536):
                over.wait(0.02)

    there = receiver(behave)
    began = time.monotonic()
    with pytest.raises(raw_ingest.RawTimeout):
        send(there.host, there.port, TOO_MUCH, timeout=0.3)
    assert time.monotonic() - began < wire.DEADLINE
    over.set()


def test_a_refusal_is_heard_though_the_packet_is_never_taken(send: Send, receiver: Receive) -> None:
    over = threading.Event()

    def behave(connection: socket.socket) -> None:
        connection.sendall(b"\x01")
        over.wait(wire.DEADLINE)

    there = receiver(behave)
    with pytest.raises(raw_ingest.RawRefused):
        send(there.host, there.port, TOO_MUCH)
    over.set()


def test_a_refusal_is_heard_though_the_connection_is_reset_after_it(
    send: Send, receiver: Receive
) -> None:
    """A receiver that closes with data unread resets the connection behind its reply."""

    def behave(connection: socket.socket) -> None:
        connection.sendall(b"\x01")

    there = receiver(behave)
    for _ in range(50):
        with pytest.raises(raw_ingest.RawRefused):
            send(there.host, there.port, MAX_PACKET)


def test_a_receiver_that_is_done_before_it_has_the_packet_is_not_believed(
    send: Send, receiver: Receive
) -> None:
    over = threading.Event()

    def behave(connection: socket.socket) -> None:
        connection.sendall(b"\x00")
        over.wait(wire.DEADLINE)

    there = receiver(behave)
    with pytest.raises(
        raw_ingest.RawError, match="answered 00 before it had the whole packet; nothing"
    ):
        send(there.host, there.port, TOO_MUCH)
    over.set()


def test_nobody_listening_raises(send: Send) -> None:
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        port = reserved.getsockname()[1]
        with pytest.raises(raw_ingest.RawError) as raised:
            send("127.0.0.1", port)
    assert str(raised.value) == (f"127.0.0.1:{port}: Connection refused; nothing was written")
    assert raised.value.maybe_written is False
    assert isinstance(raised.value.__cause__, ConnectionRefusedError)


def test_connecting_has_the_deadline_too(send: Send) -> None:
    with (
        wire.dead_address() as (host, port),
        pytest.raises(raw_ingest.RawTimeout, match="no connection within") as raised,
    ):
        send(host, port, timeout=0.2)
    assert raised.value.maybe_written is False


# Hosts


def test_names_are_looked_up(send: Send, receiver: Receive) -> None:
    there = receiver(answering(b"\x00"))
    send("localhost", there.port)


def test_the_next_address_of_a_host_is_tried(
    send: Send, receiver: Receive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """127.0.0.1 takes no connection, the receiver is at 127.0.0.2."""
    there = receiver(answering(b"\x00"), "127.0.0.2")
    found = [
        (socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, there.port))
        for host in ("127.0.0.1", "127.0.0.2")
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    send("plant", there.port)


def test_the_next_address_of_a_host_is_tried_after_a_connection_to_itself(
    send: Send, receiver: Receive, monkeypatch: pytest.MonkeyPatch
) -> None:
    own: list[Any] = []

    class Socket(socket.socket):
        """Chooses the first address that it is to connect to as its own, as a system may."""

        def connect(self, address: Any) -> None:
            if not own:
                self.bind(("127.0.0.1", 0))
                own.append(address := self.getsockname())
            super().connect(address)

    there = receiver(answering(b"\x00"))
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("127.0.0.1", there.port))] * 2
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    with monkeypatch.context() as patch:
        patch.setattr(socket, "socket", Socket)
        send("plant", there.port)
    with socket.socket() as late:
        late.bind(own[0])


def test_a_dead_address_of_a_host_leaves_time_for_the_next(
    receiver: Receive, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = receiver(answering(b"\x00"))
    with wire.dead_address() as dead:
        found = [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", address)
            for address in (dead, (there.host, there.port))
        ]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
        with ThreadPoolExecutor(2) as threads:
            sent = [
                threads.submit(send, "plant", there.port, timeout=4)
                for send in (send_async, send_sync)
            ]
        for each in sent:
            each.result()


def test_a_name_that_is_not_known_raises(send: Send, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(
        raw_ingest.RawError, match="plant:9000: Name or service not known; nothing was"
    ):
        send("plant", 9000)


@pytest.mark.usefixtures("ipv6")
def test_receivers_have_ipv6_addresses_too(send: Send, receiver: Receive) -> None:
    there = receiver(answering(b"\x01"), "::1")
    with pytest.raises(raw_ingest.RawRefused, match=rf"^\[::1\]:{there.port} refused"):
        send("::1", there.port)


@pytest.mark.parametrize(
    ("host", "port", "timeout", "text"),
    [
        ("127.0.0.1", 0, 1.0, "port is 0, allowed: 1 to 65535"),
        ("127.0.0.1", 65536, 1.0, "port is 65536, allowed: 1 to 65535"),
        ("127.0.0.1", 9000, 0.0, "timeout is 0.0, allowed: more than 0 seconds"),
        ("127.0.0.1", 9000, float("nan"), "timeout is nan, allowed: more than 0 seconds"),
        ("127.0.0.1", 9000, float("inf"), "timeout is inf, allowed: more than 0 seconds"),
        ("127.0.0.1", 9000, None, "timeout is None, allowed: more than 0 seconds"),
        ("", 9000, 1.0, "'' is not a host name"),
        ("a..b", 9000, 1.0, "'a..b' is not a host name"),
        ("10.0.0.010", 9000, 1.0, "'10.0.0.010' is not a host name"),
    ],
)
def test_arguments_that_can_not_be_are_refused(
    send: Send, host: str, port: int, timeout: Any, text: str
) -> None:
    with pytest.raises(TypeError if timeout is None else ValueError, match=f"^{text}$"):
        send(host, port, timeout=timeout)


# Cancellation


def test_a_cancelled_task_closes_its_connection(receiver: Receive) -> None:
    arrived = threading.Event()

    def behave(connection: socket.socket) -> None:
        take(connection, len(PACKET))
        arrived.set()
        until_it_ends(connection)

    there = receiver(behave)

    async def cancel() -> None:
        task = asyncio.create_task(
            raw_ingest.send_packet(there.host, there.port, PACKET, timeout=10)
        )
        await asyncio.to_thread(arrived.wait, wire.DEADLINE)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        wire.until(there.ended.is_set, "the connection is closed")

    asyncio.run(cancel(), debug=True)


def test_a_task_may_be_cancelled_at_any_step(receiver: Receive) -> None:
    def behave(connection: socket.socket) -> None:
        with contextlib.suppress(ConnectionError):
            if connection.recv(len(PACKET)):
                connection.sendall(b"\x00")

    there = receiver(behave)

    async def cancel(steps: int) -> bool:
        task = asyncio.create_task(
            raw_ingest.send_packet(there.host, there.port, PACKET, timeout=10)
        )
        for _ in range(steps):
            await asyncio.sleep(0)
        task.cancel()
        try:
            await task
        except asyncio.CancelledError:
            return False
        return True

    done = [asyncio.run(cancel(steps), debug=True) for steps in range(40)]
    assert done[0] is False
