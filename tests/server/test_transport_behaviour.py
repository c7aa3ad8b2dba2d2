"""Behaviour that Modbus over UDP, RTU over UDP and TCP, and ASCII over TCP share. The file with the
name of a transport tests what is special to it.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.client import (
    AsyncModbusTcpClient,
    AsyncModbusUdpClient,
    ModbusTcpClient,
    ModbusUdpClient,
)
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
    NOT_OF_THEIR_LENGTH,
    TRANSPORTS,
    Datagrams,
    FramedConnection,
    Transport,
    address,
    configuration,
    counters,
    is_stranger,
    rule,
    running,
)
from support.vectors import cases, overlay

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

    Peer = Datagrams | FramedConnection
    Connect = Callable[[Appliance], Any]

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
WRITE = bytes.fromhex("0600001234")
EVERY = [kind for kind in TRANSPORTS if kind != "tcp"]
FRAMERS = {None: FramerType.SOCKET, lines.RTU: FramerType.RTU, lines.ASCII: FramerType.ASCII}


def over(*kinds: str) -> pytest.MarkDecorator:
    """Runs a test once for each of some transports."""
    chosen = [TRANSPORTS[kind] for kind in kinds]
    return pytest.mark.parametrize("transport", chosen, ids=kinds, scope="module")


def over_with(name: str, pairs: Iterable[tuple[str, Any, str]]) -> pytest.MarkDecorator:
    """Runs a test once for each transport kind, value and id of the value."""
    chosen = [pytest.param(TRANSPORTS[kind], value, id=f"{kind}-{of}") for kind, value, of in pairs]
    return pytest.mark.parametrize(("transport", name), chosen)


@pytest.fixture
def appliance(run: Run, transport: Transport) -> Appliance:
    """Unit 1 is the memory plant."""
    return run(configuration(transport.kind, **transport.patient))


@pytest.fixture
def connect(transport: Transport) -> Iterator[Connect]:
    with ExitStack() as opened:
        yield lambda to: opened.enter_context(transport.client(address(to)))


@pytest.fixture
def client(appliance: Appliance, connect: Connect) -> Any:
    return connect(appliance)


# Vectors


@over_with(
    "case",
    [
        (kind, case, case["name"])
        for kind in EVERY
        for case in cases("pdu.json")
        if kind != "rtu" or case["name"] not in NOT_OF_THEIR_LENGTH
    ],
)
def test_a_pdu_is_answered_and_leaves_memory_as_its_vector_says(
    transport: Transport, case: dict[str, Any], run: Run, connect: Callable[[Appliance], Peer]
) -> None:
    size = 1000
    appliance = run(configuration(transport.kind, memories={"plant": dict.fromkeys(AREAS, size)}))
    memory = appliance.memories["plant"]
    expected = {area: [0] * size for area in AREAS}
    overlay(expected, case["setup"])
    for area in AREAS:
        memory.write(area, 0, expected[area])

    client = connect(appliance)
    assert client.ask(bytes.fromhex(case["request"])).hex() == case["response"]
    assert client.is_quiet()
    overlay(expected, case["after"])
    assert {area: memory.read(area, 0, size) for area in AREAS} == expected
    assert client.is_quiet()


@over_with(
    "case",
    [
        (kind, case, case["pdu"])
        for kind in ("rtu-udp", "rtu", "ascii")
        for case in cases("frames.json")
        # One vector is a reply. A request of its function is shorter, which matters in a stream.
        if kind != "rtu" or case["pdu"][:4] != "0306"
        # One is an exception.
        if kind != "rtu-udp" or case["pdu"][:2] < "80"
    ],
)
def test_a_frame_is_served_as_its_vector_spells_it(
    transport: Transport, case: dict[str, Any], run: Run, connect: Callable[[Appliance], Peer]
) -> None:
    client = connect(run(configuration(transport.kind, rules=[rule(["127.0.0.1"], case["unit"])])))
    ascii_mode = transport.mode is lines.ASCII
    client.send(case["ascii"].encode() if ascii_mode else bytes.fromhex(case["rtu"]))

    [(unit, reply)] = client.replies(1)
    assert (unit, reply[0] & 0x7F) == (case["unit"], int(case["pdu"][:2], 16) & 0x7F)


@over("udp", "rtu-udp")
def test_an_exception_in_a_datagram_is_ignored(
    transport: Transport, client: Peer, appliance: Appliance
) -> None:
    """Another server may have sent it, which would answer the answer, and so on without end."""
    for pdu in (b"\x80", b"\x83\x01", b"\xff" + bytes(5)):
        client.send(lines.rtu(pdu, 1) if transport.mode is lines.RTU else wire.frame(pdu))
    assert client.ask(READ) == ZERO
    assert client.is_quiet()
    found = counters(appliance)
    assert (found["frames"]["other_unit"], found["requests"]) == (3, {3: 1})


@over("udp", "rtu-udp")
def test_the_longest_request_and_the_longest_reply_fit_a_datagram(client: Datagrams) -> None:
    longest = bytes.fromhex("080000") + bytes(range(250))

    assert client.ask(longest) == longest


# Pieces of a stream


@pytest.fixture(scope="module")
def sturdy(tmp_path_factory: pytest.TempPathFactory, transport: Transport) -> Iterator[Appliance]:
    """An appliance for many examples."""
    text = configuration(transport.kind, **transport.patient)
    with running(tmp_path_factory.mktemp(transport.kind), text) as appliance:
        yield appliance


@over("rtu", "ascii")
@settings(max_examples=examples(50))
@given(data=st.data())
def test_requests_may_arrive_cut_anywhere(
    data: st.DataObject, transport: Transport, sturdy: Appliance
) -> None:
    values = data.draw(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=30))
    asked = [struct.pack(">BHH", 6, at, value) for at, value in enumerate(values)]
    stream = b"".join(transport.frame(pdu) for pdu in asked)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(stream) - 1), max_size=20)))
    with transport.client(address(sturdy)) as client:
        assert isinstance(client, FramedConnection)
        for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
            client.send(stream[start:end])
        assert client.replies(len(asked)) == [(1, pdu) for pdu in asked]
    assert sturdy.memories["plant"].read("holding_registers", 0, len(values)) == values


@over("rtu", "ascii")
def test_many_requests_in_one_piece_are_answered_in_order(
    transport: Transport, appliance: Appliance, client: FramedConnection
) -> None:
    appliance.memories["plant"].write("holding_registers", 0, range(1000))
    asked = [struct.pack(">BHH", 3, at, 1) for at in range(1000)]
    client.send(b"".join(transport.frame(pdu) for pdu in asked))

    replies = client.replies(1000)
    assert replies == [(1, struct.pack(">BBH", 3, 2, value)) for value in range(1000)]


@pytest.mark.parametrize("served", [0, 1])
@over_with(
    "begun",
    [
        ("rtu", lines.rtu(WRITE, 1)[:-1], "write"),
        ("ascii", b":", "colon"),
        ("ascii", lines.ascii_frame(WRITE, 1)[:-1], "write"),
    ],
)
def test_half_a_request_ends_the_connection_after_the_request_timeout(
    transport: Transport,
    begun: bytes,
    served: int,
    run: Run,
    connect: Callable[[Appliance], FramedConnection],
) -> None:
    # The patient frame_timeout: silence must not discard the begun request before the timeout.
    options = {**transport.patient, "request_timeout": 0.2}
    appliance = run(configuration(transport.kind, **options))
    client = connect(appliance)
    for _ in range(served):
        assert client.ask(READ) == ZERO
    client.send(begun)

    assert client.rest() == b""
    wire.until(lambda: counters(appliance)["connections"]["request_timeout"] == 1, "it is counted")
    assert appliance.memories["plant"].read("holding_registers", 0, 1) == [0]


# Units and rules


@over("rtu-udp", "rtu", "ascii")
def test_unit_0_is_an_ordinary_unit(
    transport: Transport, run: Run, connect: Callable[[Appliance], Peer]
) -> None:
    rules = [{"sources": ["127.0.0.1"], "units": {0: "plant", 1: "other"}, "access": "read-write"}]
    memories = {"plant": ALL, "other": ALL}
    client = connect(run(configuration(transport.kind, rules=rules, memories=memories)))

    assert client.ask(WRITE, 0) == WRITE
    assert client.ask(READ, 0) == bytes.fromhex("03021234")
    assert client.ask(READ, 1) == ZERO


@over("rtu-udp", "rtu", "ascii")
def test_a_unit_that_no_rule_maps_fails_to_respond(client: Peer) -> None:
    for unit in (0, 2, 247, 255):
        assert client.ask(READ, unit) == b"\x83\x0b"
        assert client.ask(b"\x63", unit) == b"\xe3\x01"


@over("udp", "rtu-udp")
def test_a_read_only_unit_is_read_and_not_written(
    transport: Transport, run: Run, connect: Callable[[Appliance], Datagrams]
) -> None:
    rules = [rule(["127.0.0.1"], access="read-only")]
    appliance = run(configuration(transport.kind, rules=rules))
    client = connect(appliance)

    assert client.ask(READ) == ZERO
    assert client.ask(WRITE) == b"\x86\x01"
    assert client.ask(bytes.fromhex("0800040000")) == b"\x88\x01"
    assert not any(content(appliance.memories["plant"])["holding_registers"])


@over("udp", "rtu-udp")
def test_a_unit_in_listen_only_mode_keeps_silent(
    transport: Transport, run: Run, connect: Callable[[Appliance], Datagrams]
) -> None:
    units = {"sources": ["127.0.0.1"], "units": {1: "plant", 2: "plant"}, "access": "read-write"}
    client = connect(run(configuration(transport.kind, rules=[units], listen_only=True)))
    for request in (bytes.fromhex("0800040000"), READ, b"\x63"):
        client.send(transport.frame(request))
    assert client.ask(READ, 2) == ZERO
    client.send(transport.frame(bytes.fromhex("0800010000")))
    assert client.ask(READ) == ZERO
    assert client.is_quiet()


@needs_127_0_0_2
@over("udp", "rtu-udp", "ascii")
def test_a_stranger_is_refused_and_counted_and_logged(
    transport: Transport,
    run: Run,
    connect: Callable[[Appliance], Peer],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING, "holdfast")
    appliance = run(configuration(transport.kind, rules=[rule(["127.0.0.1"])]))

    assert is_stranger(transport.kind, appliance, address(appliance), "127.0.0.2")
    assert counters(appliance)["requests"] == {}
    assert connect(appliance).ask(READ) == ZERO
    appliance.log_events(wire.DEADLINE)
    assert "refused_source" in [record.message for record in caplog.records]
    assert counters(appliance)["requests"] == {3: 1}


# Stop


@over("udp", "rtu-udp")
def test_datagrams_received_before_a_stop_are_answered(
    transport: Transport, appliance: Appliance, client: Datagrams
) -> None:
    appliance.memories["plant"].write("holding_registers", 0, range(100))
    for at in range(100):
        client.send(transport.frame(struct.pack(">BHH", 3, at, 1), transaction=at))
    appliance.stop()

    replies = [client.receive() for _ in range(100)]
    assert [reply.pdu for reply in replies] == [struct.pack(">BBH", 3, 2, at) for at in range(100)]
    assert {reply.unit for reply in replies} == {1}
    if transport.mode is None:
        assert [reply.transaction for reply in replies] == list(range(100))


@over_with("begun_bytes", [("rtu", 4, "4"), ("ascii", -1, "all-but-one")])
def test_requests_received_before_a_stop_are_answered_on_a_stream(
    transport: Transport, begun_bytes: int, appliance: Appliance, client: FramedConnection
) -> None:
    """The incomplete request after them is not answered."""
    assert client.ask(READ) == ZERO
    client.send(transport.frame(READ) * 100 + transport.frame(WRITE)[:begun_bytes])
    appliance.stop()

    assert client.replies(100) == [(1, ZERO)] * 100
    assert client.rest() == b""


# Real clients


@pytest.fixture
def acme(run: Run, transport: Transport) -> Appliance:
    """An appliance with the vendor name that pymodbus asks for."""
    return run(configuration(transport.kind, more={"identity": {"vendor_name": "Acme"}}))


@over(*EVERY)
def test_pymodbus_reads_and_writes(transport: Transport, acme: Appliance) -> None:
    host, port = address(acme)
    kind = ModbusUdpClient if "udp" in transport.kind else ModbusTcpClient

    with connected(kind(host, port=port, framer=FRAMERS[transport.mode], **OPTIONS)) as client:
        tour(client, acme.memories["plant"], 1)


@over(*EVERY)
def test_pymodbus_reads_and_writes_with_asyncio(transport: Transport, acme: Appliance) -> None:
    host, port = address(acme)
    kind = AsyncModbusUdpClient if "udp" in transport.kind else AsyncModbusTcpClient

    def made() -> AsyncModbusUdpClient | AsyncModbusTcpClient:
        return kind(host, port=port, framer=FRAMERS[transport.mode], **OPTIONS)

    with Patient(made) as client:
        tour(client, acme.memories["plant"], 1)
        replies = client.many("read_holding_registers", range(100, 200))
    assert [reply.registers for reply in replies] == [[value] for value in range(100)]


def url(transport: Transport, appliance: Appliance) -> str:
    host, port = address(appliance)
    return f"{transport.scheme}://{host}:{port}"


@over("rtu-udp", "ascii")
def test_the_sync_client_reads_and_writes(transport: Transport, appliance: Appliance) -> None:
    with holdfast.SyncClient(url(transport, appliance), timeout=wire.DEADLINE) as plc:
        plc.write_registers(5, list(range(123)))
        assert plc.read_holding_registers(5, 123) == list(range(123))
        with pytest.raises(holdfast.ModbusException):
            plc.read_coils(1000, 1)


@over("rtu-udp", "ascii")
def test_the_client_reads_and_writes(transport: Transport, appliance: Appliance) -> None:
    async def asked() -> list[bool]:
        async with holdfast.Client(url(transport, appliance), timeout=wire.DEADLINE) as plc:
            await plc.write_coils(3, [True, False, True])
            return await plc.read_coils(3, 3)

    assert asyncio.run(asked()) == [True, False, True]
