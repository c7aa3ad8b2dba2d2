"""Raw Ingest packets on the port of a Modbus TCP server, and several packets on one connection."""

from __future__ import annotations

import logging
import socket
import struct
import zlib
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from support import wire
from support.config_folder import written
from support.machine import needs_127_0_0_2
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.appliance import Appliance
    from support.running import Connect, Run

DONE, REFUSED = b"\x00", b"\x01"
SOURCES = ["127.0.0.0/8"]
READ = b"\x03\x00\x00\x00\x02"
MANY, CONTINUE = {"packets": "many"}, {"after_refusal": "continue"}
NO_CRC, ANY_FLAGS = {"crc": "none"}, {"flags": "ignore"}


def packet(address: int, *values: int, area: int = 3, unit: int = 1) -> bytes:
    head = struct.pack(">2sBBHHH", b"RI", 1, area, unit, address, len(values))
    return head + struct.pack(f">{len(values)}H", *values)


def configuration(
    part: dict[str, Any] | None = None, *, kind: str = "modbus-tcp", **more: Any
) -> str:
    by_id = (part or {}).get("format") == "crc"
    target: dict[str, Any] = {"memories": ["plant"]} if by_id else {"units": {1: "plant"}}
    raw = {"sources": SOURCES, **target, "areas": ["holding_registers"]}
    rule: dict[str, Any] = {"sources": SOURCES, "units": {1: "plant"}, "access": "read-write"}
    listener: dict[str, Any] = {"type": kind, "bind": "127.0.0.1:0", **more}
    if kind == "modbus-tcp":
        listener |= {"rules": [rule], "raw_ingest": {"rules": [raw], **(part or {})}}
    else:
        listener |= {"rules": [raw], **(part or {})}
    return written(
        {
            "memories": {"plant": {"id": 7, "holding_registers": 100}},
            "listeners": {"both": listener},
        }
    )


@pytest.fixture
def dial() -> Iterator[Any]:
    with ExitStack() as opened:

        def connect(appliance: Appliance) -> socket.socket:
            made = socket.create_connection(endpoint(appliance, "both"), timeout=wire.DEADLINE)
            return opened.enter_context(made)

        yield connect


def registers(appliance: Appliance, count: int = 4) -> list[int]:
    return appliance.memories["plant"].read("holding_registers", 0, count)


def counters(appliance: Appliance) -> dict[str, Any]:
    counted: dict[str, Any] = appliance.diagnostics.stats()["listeners"]["both"]
    return counted


def test_both_protocols_have_one_port(run: Run, dial: Any, connect: Connect) -> None:
    appliance = run(configuration())
    sender = dial(appliance)
    sender.sendall(packet(0, 7, 8))
    assert (sender.recv(2), sender.recv(1)) == (DONE, b"")
    with connect(endpoint(appliance, "both")) as client:
        assert client.ask(READ) == b"\x03\x04\x00\x07\x00\x08"
    counted = counters(appliance)
    assert (counted["packets"]["accepted"], counted["requests"]) == (1, {3: 1})


def test_a_connection_may_begin_slowly(run: Run, dial: Any) -> None:
    appliance = run(configuration())
    sender, client = dial(appliance), dial(appliance)
    for byte in packet(0, 7):
        sender.sendall(bytes([byte]))
    assert sender.recv(1) == DONE
    for byte in wire.frame(READ, 1, 0x5249):
        client.sendall(bytes([byte]))
    assert client.recv(100) == wire.frame(b"\x03\x04\x00\x07\x00\x00", 1, 0x5249)


def test_a_modbus_request_whose_transaction_id_is_that_of_a_packet_is_modbus(
    run: Run, dial: Any
) -> None:
    appliance = run(configuration())
    client = dial(appliance)
    request = wire.frame(READ, 1, 0x5249)
    client.sendall(request[:2])
    client.sendall(request[2:] + request)
    expected = wire.frame(b"\x03\x04\x00\x00\x00\x00", 1, 0x5249) * 2
    received = b""
    while len(received) < len(expected):
        received += client.recv(100)
    assert received == expected


@pytest.mark.parametrize(("version", "area"), [(1, 3), (1, 9), (2, 3), (0, 3)])
def test_a_packet_among_modbus_frames_ends_the_connection(
    run: Run, dial: Any, version: int, area: int
) -> None:
    """The unit id of the packet is the length of a frame, behind which the payload is a request."""
    appliance = run(configuration())
    client = dial(appliance)
    client.sendall(wire.frame(READ, 1, 1))
    assert client.recv(100) == wire.frame(b"\x03\x04\x00\x00\x00\x00", 1, 1)
    start = packet(0, 0, area=area, unit=2)[:8]
    start = start[:2] + bytes([version]) + start[3:]
    client.sendall(start + wire.frame(b"\x06\x00\x00\x00\x07", 1, 1))
    with suppress(ConnectionResetError):
        assert client.recv(100) == b""
    counted = counters(appliance)
    assert counted["frames"]["broken"] == 1
    assert counted["packets"] == {**counted["packets"], "accepted": 0, "refused": {}}
    assert registers(appliance) == [0, 0, 0, 0]


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
@pytest.mark.parametrize("part", [{}, {"compat": MANY | CONTINUE}], ids=["one", "many"])
@pytest.mark.parametrize(
    ("version", "area", "reason"),
    [(2, 3, "version"), (0, 3, "version"), (255, 0, "version"), (1, 0, "area"), (1, 9, "area")],
)
def test_a_packet_of_a_wrong_version_or_area_is_answered_with_one_byte(
    run: Run, dial: Any, kind: str, part: dict[str, Any], version: int, area: int, reason: str
) -> None:
    appliance = run(configuration(part, kind=kind))
    sent = packet(0, 7)
    sent = sent[:2] + bytes([version, area]) + sent[4:]
    whole, slow = dial(appliance), dial(appliance)
    whole.sendall(sent)
    for byte in sent[:4]:
        slow.sendall(bytes([byte]))
    for sender in (whole, slow):
        assert (sender.recv(2), sender.recv(1)) == (REFUSED, b"")
    counted = counters(appliance)
    assert counted["packets"]["refused"] == {reason: 2}
    assert counted.get("requests", {}) == {}
    assert registers(appliance) == [0, 0, 0, 0]


def test_a_sender_without_a_rule_is_refused_and_may_speak_modbus(run: Run, dial: Any) -> None:
    text = configuration()
    elsewhere = text.replace(
        '"raw_ingest": {"rules": [{"sources": ["127.0.0.0/8"]',
        '"raw_ingest": {"rules": [{"sources": ["10.0.0.0/8"]',
    )
    assert elsewhere != text
    appliance = run(elsewhere)
    sender, client = dial(appliance), dial(appliance)
    sender.sendall(packet(0, 7))
    assert sender.recv(1) == REFUSED
    client.sendall(wire.frame(READ, 1, 1))
    assert client.recv(100) == wire.frame(b"\x03\x04\x00\x00\x00\x00", 1, 1)
    assert counters(appliance)["packets"]["refused"] == {"not_granted": 1}


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
def test_a_connection_can_carry_many_packets(run: Run, dial: Any, kind: str) -> None:
    appliance = run(configuration({"compat": MANY}, kind=kind))
    sender = dial(appliance)
    sender.sendall(packet(0, 1))
    assert sender.recv(1) == DONE
    # Two and a half, then the rest.
    third = packet(3, 4)
    sender.sendall(packet(1, 2) + packet(2, 3) + third[:7])
    assert sender.recv(1) + sender.recv(1) == DONE * 2
    sender.sendall(third[7:])
    assert sender.recv(1) == DONE
    assert registers(appliance) == [1, 2, 3, 4]
    sender.shutdown(socket.SHUT_WR)
    assert sender.recv(1) == b""
    assert counters(appliance)["packets"]["accepted"] == 4


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
def test_a_refused_packet_ends_a_connection_with_many(run: Run, dial: Any, kind: str) -> None:
    appliance = run(configuration({"compat": MANY}, kind=kind))
    sender = dial(appliance)
    sender.sendall(packet(0, 1) + packet(99, 2, 3) + packet(1, 4))
    assert sender.recv(1) + sender.recv(1) == DONE + REFUSED
    assert registers(appliance) == [1, 0, 0, 0]
    assert counters(appliance)["packets"]["refused"] == {"range": 1}


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
def test_a_connection_can_go_on_after_a_refused_packet(run: Run, dial: Any, kind: str) -> None:
    appliance = run(configuration({"compat": MANY | CONTINUE}, kind=kind))
    sender = dial(appliance)
    refused = [packet(99, 2, 3), packet(0, 4, unit=2), packet(0, 5, area=4)]
    pieces = [packet(0, 1), *refused, packet(1, 2)]
    for byte in b"".join(pieces):
        sender.sendall(bytes([byte]))
    replies = b"".join(sender.recv(1) for _ in pieces)
    assert replies == DONE + REFUSED * 3 + DONE
    assert registers(appliance) == [1, 2, 0, 0]
    assert counters(appliance)["packets"]["refused"] == {"range": 1, "unit": 1, "not_granted": 1}
    # After an invalid header, the next packet can't be found.
    sender.sendall(packet(0, 6, area=5) + packet(2, 3))
    assert (sender.recv(2), sender.recv(1)) == (REFUSED, b"")
    assert registers(appliance) == [1, 2, 0, 0]


def with_memory_id(address: int, *values: int, flags: int = 0, reserved: int = 0) -> bytes:
    """A packet of format crc, without its CRC."""
    head = struct.pack(">2sBBBBHHH", b"RI", 1, flags, 3, reserved, 7, address, len(values))
    return head + struct.pack(f">{len(values)}H", *values)


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
@pytest.mark.parametrize(("flags", "reserved"), [(1, 0), (0, 1), (255, 255)])
def test_flags_can_be_ignored(run: Run, dial: Any, kind: str, flags: int, reserved: int) -> None:
    lenient = run(configuration({"format": "crc", "compat": NO_CRC | ANY_FLAGS}, kind=kind))
    strict = run(configuration({"format": "crc", "compat": NO_CRC}, kind=kind))
    sent = with_memory_id(0, 7, 8, flags=flags, reserved=reserved)
    sender = dial(lenient)
    for byte in sent:
        sender.sendall(bytes([byte]))
    assert (sender.recv(2), sender.recv(1)) == (DONE, b"")
    assert registers(lenient) == [7, 8, 0, 0]
    sender = dial(strict)
    sender.sendall(sent)
    sender.shutdown(socket.SHUT_WR)
    assert (sender.recv(2), sender.recv(1)) == (REFUSED, b"")
    assert registers(strict) == [0, 0, 0, 0]


def test_modbus_needs_no_more_bytes_where_flags_are_ignored(run: Run, dial: Any) -> None:
    appliance = run(configuration({"format": "crc", "compat": NO_CRC | ANY_FLAGS}))
    client = dial(appliance)
    for byte in wire.frame(READ, 1, 0x5249):
        client.sendall(bytes([byte]))
    assert client.recv(100) == wire.frame(b"\x03\x04\x00\x00\x00\x00", 1, 0x5249)
    assert counters(appliance)["packets"]["refused"] == {}


def crc_of(body: bytes) -> bytes:
    return zlib.crc32(body).to_bytes(4, "big")


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
def test_a_crc_that_is_not_expected_is_surplus_however_it_arrives(
    run: Run, dial: Any, kind: str
) -> None:
    appliance = run(configuration({"format": "crc", "compat": NO_CRC}, kind=kind))
    body = with_memory_id(0, 7, 8)
    sent = body + crc_of(body)
    for number, cut in enumerate(range(1, len(sent) + 1), 1):
        appliance.memories["plant"].write("holding_registers", 0, [0, 0])
        with dial(appliance) as sender:
            sender.sendall(sent[:cut])
            wire.until_taken(sender)
            sender.sendall(sent[cut:])
            assert (sender.recv(2), sender.recv(1)) == (DONE, b"")
        assert registers(appliance) == [7, 8, 0, 0]
        wire.until(lambda: counters(appliance)["connections"]["open"] == 0, "it has ended")
        assert counters(appliance)["packets"]["surplus_bytes"] == 4 * number
    assert counters(appliance)["packets"]["accepted"] == len(sent)
    assert counters(appliance)["packets"]["refused"] == {}


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
def test_among_many_packets_a_crc_that_is_not_expected_is_the_next_one(
    run: Run, dial: Any, kind: str
) -> None:
    part = {"format": "crc", "compat": NO_CRC | MANY | CONTINUE}
    appliance = run(configuration(part, kind=kind))
    body = with_memory_id(0, 7, 8)
    sender = dial(appliance)
    sender.sendall(body + crc_of(body))
    assert (sender.recv(1), sender.recv(1), sender.recv(1)) == (DONE, REFUSED, b"")
    counted = counters(appliance)["packets"]
    assert (counted["refused"], counted["surplus_bytes"]) == ({"magic": 1}, 0)


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
@pytest.mark.parametrize("part", [{}, {"compat": MANY}], ids=["one", "many"])
def test_silent_connections_are_evicted_before_those_amid_a_packet(
    run: Run, dial: Any, kind: str, part: dict[str, Any]
) -> None:
    limits: dict[str, Any] = {"max_connections": 3, "when_full": "evict"}
    limits["max_connections_per_source"] = None
    appliance = run(configuration(part, kind=kind, **limits))
    begun = dial(appliance)
    begun.sendall(packet(0, 1)[:-1])
    wire.until_taken(begun)
    silent = [dial(appliance) for _ in range(5)]
    assert [each.recv(1) for each in silent[:3]] == [b""] * 3
    assert counters(appliance)["connections"]["evicted"] == 3
    begun.sendall(packet(0, 1)[-1:])
    assert begun.recv(1) == DONE
    late = dial(appliance)
    late.sendall(packet(1, 2))
    assert late.recv(1) == DONE
    assert registers(appliance) == [1, 2, 0, 0]


@needs_127_0_0_2
def test_silent_connections_of_one_source_evict_each_other(run: Run, dial: Any) -> None:
    limits: dict[str, Any] = {
        "max_connections": 2,
        "max_connections_per_source": 1,
        "when_full": "evict",
    }
    appliance = run(configuration(kind="raw-ingest", **limits))
    other = socket.create_connection(
        endpoint(appliance, "both"), timeout=wire.DEADLINE, source_address=("127.0.0.2", 0)
    )
    with other:
        silent = [dial(appliance) for _ in range(3)]
        assert [each.recv(1) for each in silent[:2]] == [b""] * 2
        other.sendall(packet(0, 1))
        assert other.recv(1) == DONE
    assert counters(appliance)["connections"]["evicted"] == 2


def test_half_a_packet_is_refused(run: Run, dial: Any) -> None:
    appliance = run(configuration({"compat": MANY}))
    sender = dial(appliance)
    sender.sendall(packet(0, 1) + packet(1, 2)[:-1])
    assert sender.recv(1) == DONE
    sender.shutdown(socket.SHUT_WR)
    assert sender.recv(1) == REFUSED
    assert counters(appliance)["packets"]["refused"] == {"short": 1}


@pytest.mark.parametrize("kind", ["modbus-tcp", "raw-ingest"])
def test_packets_are_written_though_their_sender_has_left(run: Run, dial: Any, kind: str) -> None:
    appliance = run(configuration({"compat": MANY}, kind=kind))
    sender = dial(appliance)
    sender.sendall(b"".join(packet(address, address + 1) for address in range(100)))
    sender.close()
    wire.until(lambda: counters(appliance)["packets"]["accepted"] == 100, "all are written")
    assert registers(appliance, 100) == list(range(1, 101))


def test_what_is_left_of_a_packet_is_counted_when_its_connection_breaks(
    run: Run, dial: Any, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = run(configuration({"compat": MANY}, kind="raw-ingest"))
    sender = dial(appliance)
    sender.sendall(packet(0, 1) + packet(1, 2)[:5])
    assert sender.recv(1) == DONE
    sender.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    peer = "{}:{}".format(*sender.getsockname())
    sender.close()
    wire.until(lambda: counters(appliance)["packets"]["dropped_bytes"] == 5, "they are counted")

    def logged() -> list[Any]:
        appliance.log_events(0.1)
        return [vars(each)["fields"] for each in caplog.records if each.msg == "bytes_dropped"]

    with caplog.at_level(logging.WARNING, "holdfast"):
        wire.until(logged, "it is logged")
    assert logged() == [{"listener": "both", "peer": peer, "bytes": 5}]


def test_packets_without_a_next_one_end_by_themselves(run: Run, dial: Any) -> None:
    appliance = run(configuration({"compat": MANY, "idle_timeout": 0.2}, kind="raw-ingest"))
    sender = dial(appliance)
    sender.sendall(packet(0, 1))
    assert (sender.recv(1), sender.recv(1)) == (DONE, b"")
    assert counters(appliance)["connections"]["idle"] == 1


def test_other_listeners_take_no_packets() -> None:
    memory = holdfast.Memory(holding_registers=1)
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
        sender = socket.create_connection(server.address, timeout=wire.DEADLINE)
        with sender:
            sender.sendall(packet(0, 7))
            sender.shutdown(socket.SHUT_WR)
            assert sender.recv(1) == b""
    assert memory.read("holding_registers", 0, 1) == [0]
