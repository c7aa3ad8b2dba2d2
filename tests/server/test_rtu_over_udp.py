"""RTU over UDP: a datagram is a request if it is exactly one frame; anything else gets no reply."""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymodbus.client import AsyncModbusUdpClient, ModbusUdpClient
from pymodbus.framer import FramerType

import holdfast
from holdfast.types import AREAS
from support import lines, wire
from support.cases import examples
from support.machine import needs_127_0_0_2
from support.pymodbus_peer import OPTIONS, Patient, connected, tour
from support.running import content
from support.transports import (
    ALL,
    RtuDatagrams,
    address,
    configuration,
    counters,
    is_stranger,
    rule,
    running,
)
from support.vectors import cases, overlay

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
WRITE = bytes.fromhex("0600001234")


@pytest.fixture
def appliance(run: Run) -> Appliance:
    """Unit 1 is the memory plant."""
    return run(configuration("rtu-udp"))


@pytest.fixture
def client(appliance: Appliance) -> Iterator[RtuDatagrams]:
    with RtuDatagrams(address(appliance)) as made:
        yield made


# Vectors


@pytest.mark.parametrize("case", cases("pdu.json"), ids=lambda case: case["name"])
def test_a_pdu_is_answered_and_leaves_memory_as_its_vector_says(
    case: dict[str, Any], run: Run
) -> None:
    size = 1000
    appliance = run(configuration("rtu-udp", memories={"plant": dict.fromkeys(AREAS, size)}))
    memory = appliance.memories["plant"]
    expected = {area: [0] * size for area in AREAS}
    overlay(expected, case["setup"])
    for area in AREAS:
        memory.write(area, 0, expected[area])

    with RtuDatagrams(address(appliance)) as client:
        assert client.ask(bytes.fromhex(case["request"])).hex() == case["response"]
        assert client.is_quiet()
    overlay(expected, case["after"])
    assert {area: memory.read(area, 0, size) for area in AREAS} == expected


@pytest.mark.parametrize("case", cases("frames.json"), ids=lambda case: case["pdu"])
def test_a_frame_is_served_as_its_vector_spells_it(case: dict[str, Any], run: Run) -> None:
    appliance = run(configuration("rtu-udp", rules=[rule(["127.0.0.1"], case["unit"])]))
    with RtuDatagrams(address(appliance)) as client:
        client.send(bytes.fromhex(case["rtu"]))
        reply = client.receive()

    assert (reply.unit, reply.pdu[0] & 0x7F) == (case["unit"], int(case["pdu"][:2], 16) & 0x7F)


# Datagrams that are no request


@pytest.mark.parametrize(
    "datagram",
    [
        lines.rtu(WRITE, 1) * 2,
        lines.rtu(WRITE, 1) + b"\x01",
        b"\x00" + lines.rtu(WRITE, 1),
        lines.rtu(WRITE, 1)[:-1],
        lines.RTU.damaged(WRITE, 1),
        lines.ascii_frame(WRITE, 1),
        wire.frame(WRITE),
        lines.rtu(b"", 1),
        lines.rtu(b"", 1)[:2],
        b"\x00",
        b"",
        b"GET / HTTP/1.1\r\n\r\n",
        lines.rtu(bytes.fromhex("080000") + bytes(251), 1),
        lines.rtu(WRITE, 1) + bytes(65_000),
        bytes(65_000),
    ],
    ids=lambda datagram: f"{len(datagram)}-{datagram[:8].hex()}",
)
def test_what_is_not_exactly_one_frame_is_counted_as_damaged_and_not_answered(
    datagram: bytes, appliance: Appliance, client: RtuDatagrams
) -> None:
    client.send(datagram)

    assert client.ask(READ) == ZERO
    assert client.is_quiet()
    frames = counters(appliance)["frames"]
    assert {kind: number for kind, number in frames.items() if number} == {"damaged": 1}
    assert counters(appliance)["requests"] == {3: 1}
    assert not any(any(values) for values in content(appliance.memories["plant"]).values())


def test_a_zero_byte_after_a_frame_makes_a_request_of_wrong_length(
    appliance: Appliance, client: RtuDatagrams
) -> None:
    """The CRC of a frame and a zero byte always fits, so the length of the PDU tells."""
    client.send(lines.rtu(WRITE, 1) + b"\x00")

    assert client.receive().pdu == b"\x86\x03"
    assert appliance.memories["plant"].read("holding_registers", 0, 1) == [0]


def test_damaged_datagrams_are_communication_errors_of_the_diagnostics(
    client: RtuDatagrams,
) -> None:
    for _ in range(3):
        client.send(lines.RTU.damaged(READ, 1))

    assert client.ask(bytes.fromhex("08000c0000")) == bytes.fromhex("08000c0003")


def test_the_longest_request_and_the_longest_reply_fit_a_datagram(client: RtuDatagrams) -> None:
    longest = bytes.fromhex("080000") + bytes(range(250))

    assert client.ask(longest) == longest


def test_an_unknown_function_of_any_length_is_an_illegal_function(client: RtuDatagrams) -> None:
    for length in (0, 1, 5, 252):
        assert client.ask(b"\x63" + bytes(length)) == b"\xe3\x01"


@pytest.fixture(scope="module")
def sturdy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    """An appliance for many datagrams, none of which can silence a unit."""
    rules = [rule(["127.0.0.1"], deny=[8]), rule(["127.0.0.2"])]
    text = configuration("rtu-udp", rules=rules)
    with running(tmp_path_factory.mktemp("rtu-udp"), text) as appliance:
        yield appliance


datagrams = st.one_of(
    st.binary(max_size=300),
    st.builds(lines.rtu, st.binary(max_size=260), st.integers(0, 255)),
    st.builds(
        lambda pdu, at, bit: _flipped(lines.rtu(pdu, 1), at, bit),
        st.binary(min_size=1, max_size=252),
        st.integers(0, 254),
        st.integers(0, 7),
    ),
)


def _flipped(frame: bytes, at: int, bit: int) -> bytes:
    changed = bytearray(frame)
    changed[at % len(frame)] ^= 1 << bit
    return bytes(changed)


def is_frame(datagram: bytes) -> bool:
    return 4 <= len(datagram) <= 256 and lines.crc(datagram[:-2]) == datagram[-2:]


@settings(max_examples=examples(200), suppress_health_check=[HealthCheck.too_slow])
@given(garbage=st.lists(datagrams, max_size=20))
def test_of_any_datagrams_exactly_the_frames_are_answered(
    garbage: list[bytes], sturdy: Appliance
) -> None:
    damaged = counters(sturdy)["frames"]["damaged"]
    with RtuDatagrams(address(sturdy)) as client:
        for datagram in garbage:
            client.send(datagram)
        client.send(lines.rtu(READ, 77))
        asked = [datagram for datagram in [*garbage, lines.rtu(READ, 77)] if is_frame(datagram)]
        replies = [client.receive() for _ in asked]
        assert client.is_quiet()
    for datagram, reply in zip(asked, replies, strict=True):
        assert (reply.unit, reply.pdu[0] & 0x7F) == (datagram[0], datagram[1] & 0x7F)
    assert replies[-1].pdu == b"\x83\x0b"
    told = counters(sturdy)["frames"]["damaged"] - damaged
    assert told == sum(not is_frame(datagram) for datagram in garbage)


# Units and rules


def test_unit_0_is_an_ordinary_unit(run: Run) -> None:
    rules = [{"sources": ["127.0.0.1"], "units": {0: "plant", 1: "other"}, "access": "read-write"}]
    appliance = run(configuration("rtu-udp", rules=rules, memories={"plant": ALL, "other": ALL}))
    with RtuDatagrams(address(appliance)) as client:
        assert client.ask(WRITE, 0) == WRITE
        assert client.ask(READ, 0) == bytes.fromhex("03021234")
        assert client.ask(READ, 1) == ZERO


def test_a_unit_that_no_rule_maps_fails_to_respond(client: RtuDatagrams) -> None:
    for unit in (0, 2, 247, 255):
        assert client.ask(READ, unit) == b"\x83\x0b"


def test_a_read_only_unit_is_read_and_not_written(run: Run) -> None:
    appliance = run(configuration("rtu-udp", rules=[rule(["127.0.0.1"], access="read-only")]))
    with RtuDatagrams(address(appliance)) as client:
        assert client.ask(READ) == ZERO
        assert client.ask(WRITE) == b"\x86\x01"


@needs_127_0_0_2
def test_a_stranger_is_not_answered_and_counted(run: Run) -> None:
    appliance = run(configuration("rtu-udp", rules=[rule(["127.0.0.1"])]))

    assert is_stranger("rtu-udp", appliance, address(appliance), "127.0.0.2")
    assert counters(appliance)["requests"] == {}


def test_a_unit_in_listen_only_mode_keeps_silent(run: Run) -> None:
    units = {"sources": ["127.0.0.1"], "units": {1: "plant", 2: "plant"}, "access": "read-write"}
    appliance = run(configuration("rtu-udp", rules=[units], listen_only=True))
    with RtuDatagrams(address(appliance)) as client:
        for request in (bytes.fromhex("0800040000"), READ, b"\x63"):
            client.send(lines.rtu(request, 1))
        assert client.ask(READ, 2) == ZERO
        client.send(lines.rtu(bytes.fromhex("0800010000"), 1))
        assert client.ask(READ) == ZERO
        assert client.is_quiet()


# Stop


def test_what_was_received_before_a_stop_is_answered(
    appliance: Appliance, client: RtuDatagrams
) -> None:
    appliance.memories["plant"].write("holding_registers", 0, range(100))
    for at in range(100):
        client.send(lines.rtu(struct.pack(">BHH", 3, at, 1), 1))
    appliance.stop()

    replies = [client.receive().pdu for _ in range(100)]
    assert replies == [struct.pack(">BBH", 3, 2, value) for value in range(100)]


# Real clients


def test_pymodbus_reads_and_writes(run: Run) -> None:
    appliance = run(configuration("rtu-udp", more={"identity": {"vendor_name": "Acme"}}))
    host, port = address(appliance)

    client = ModbusUdpClient(host, port=port, framer=FramerType.RTU, **OPTIONS)
    with connected(client):
        tour(client, appliance.memories["plant"], 1)


def test_pymodbus_reads_and_writes_with_asyncio(run: Run) -> None:
    appliance = run(configuration("rtu-udp", more={"identity": {"vendor_name": "Acme"}}))
    host, port = address(appliance)

    def made() -> AsyncModbusUdpClient:
        return AsyncModbusUdpClient(host, port=port, framer=FramerType.RTU, **OPTIONS)

    with Patient(made) as client:
        tour(client, appliance.memories["plant"], 1)


def test_the_sync_client_reads_and_writes(appliance: Appliance) -> None:
    host, port = address(appliance)
    with holdfast.SyncClient(f"rtu+udp://{host}:{port}", timeout=wire.DEADLINE) as plc:
        plc.write_registers(5, list(range(123)))
        assert plc.read_holding_registers(5, 123) == list(range(123))
        with pytest.raises(holdfast.ModbusException):
            plc.read_coils(1000, 1)


def test_the_client_reads_and_writes(appliance: Appliance) -> None:
    host, port = address(appliance)

    async def asked() -> list[bool]:
        async with holdfast.Client(f"rtu+udp://{host}:{port}", timeout=wire.DEADLINE) as plc:
            await plc.write_coils(3, [True, False, True])
            return await plc.read_coils(3, 3)

    assert asyncio.run(asked()) == [True, False, True]
