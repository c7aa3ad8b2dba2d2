"""ASCII frames in a TCP connection: a colon starts one, CR LF ends it."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.client import AsyncModbusTcpClient, ModbusTcpClient
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
    AsciiConnection,
    address,
    configuration,
    counters,
    is_stranger,
    rule,
    running,
)
from support.vectors import cases, overlay

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

    Connect = Callable[[Appliance], AsciiConnection]

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
WRITE = bytes.fromhex("0600001234")
MAX_FRAME = 513
"""Colon, the digits of 255 bytes, CR and LF."""
DIGITS = set(b"0123456789ABCDEFabcdef")


def framed(pdus: list[bytes]) -> bytes:
    return b"".join(lines.ascii_frame(pdu, 1) for pdu in pdus)


@pytest.fixture
def appliance(run: Run) -> Appliance:
    """Unit 1 is the memory plant."""
    return run(configuration("ascii"))


@pytest.fixture
def connect() -> Iterator[Connect]:
    with ExitStack() as opened:
        yield lambda to: opened.enter_context(AsciiConnection(address(to)))


@pytest.fixture
def client(appliance: Appliance, connect: Connect) -> AsciiConnection:
    return connect(appliance)


@pytest.fixture(scope="module")
def sturdy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    """An appliance for many examples, none of which can silence a unit or change the delimiter."""
    text = configuration("ascii", rules=[rule(["127.0.0.1"], deny=[8])])
    with running(tmp_path_factory.mktemp("ascii"), text) as appliance:
        yield appliance


# Vectors


@pytest.mark.parametrize("case", cases("pdu.json"), ids=lambda case: case["name"])
def test_a_pdu_is_answered_and_leaves_memory_as_its_vector_says(
    case: dict[str, Any], run: Run, connect: Connect
) -> None:
    size = 1000
    appliance = run(configuration("ascii", memories={"plant": dict.fromkeys(AREAS, size)}))
    memory = appliance.memories["plant"]
    expected = {area: [0] * size for area in AREAS}
    overlay(expected, case["setup"])
    for area in AREAS:
        memory.write(area, 0, expected[area])

    client = connect(appliance)
    assert client.ask(bytes.fromhex(case["request"])).hex() == case["response"]
    overlay(expected, case["after"])
    assert {area: memory.read(area, 0, size) for area in AREAS} == expected
    assert client.is_quiet()


@pytest.mark.parametrize("case", cases("frames.json"), ids=lambda case: case["pdu"])
def test_a_frame_is_served_as_its_vector_spells_it(
    case: dict[str, Any], run: Run, connect: Connect
) -> None:
    client = connect(run(configuration("ascii", rules=[rule(["127.0.0.1"], case["unit"])])))
    client.send(case["ascii"].encode())

    [(unit, reply)] = client.replies(1)
    assert (unit, reply[0] & 0x7F) == (case["unit"], int(case["pdu"][:2], 16) & 0x7F)


# Pieces


@settings(max_examples=examples(50))
@given(data=st.data())
def test_requests_may_arrive_cut_anywhere(data: st.DataObject, sturdy: Appliance) -> None:
    values = data.draw(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=30))
    asked = [struct.pack(">BHH", 6, at, value) for at, value in enumerate(values)]
    stream = framed(asked)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(stream) - 1), max_size=20)))
    with AsciiConnection(address(sturdy)) as client:
        for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
            client.send(stream[start:end])
        assert client.replies(len(asked)) == [(1, pdu) for pdu in asked]
    assert sturdy.memories["plant"].read("holding_registers", 0, len(values)) == values


def test_many_requests_in_one_piece_are_answered_in_order(
    appliance: Appliance, client: AsciiConnection
) -> None:
    appliance.memories["plant"].write("holding_registers", 0, range(1000))
    client.send(framed([struct.pack(">BHH", 3, at, 1) for at in range(1000)]))

    replies = client.replies(1000)
    assert replies == [(1, struct.pack(">BBH", 3, 2, value)) for value in range(1000)]


def test_the_longest_request_and_the_longest_reply_are_served(client: AsciiConnection) -> None:
    longest = bytes.fromhex("080000") + bytes(range(250))
    assert len(lines.ascii_frame(longest, 1)) == MAX_FRAME

    assert client.ask(longest) == longest


def test_many_long_replies_to_one_piece_arrive_whole(
    appliance: Appliance, client: AsciiConnection
) -> None:
    values = list(range(1000, 1125))
    appliance.memories["plant"].write("holding_registers", 0, values)
    client.send(framed([bytes.fromhex("030000007d")] * 200))

    assert client.replies(200) == [(1, struct.pack(">BB125H", 3, 250, *values))] * 200


# Characters around frames, and frames that are not served


def test_digits_may_be_lower_case(client: AsciiConnection) -> None:
    client.send(lines.ascii_frame(bytes.fromhex("0600abcdef"), 1).lower())

    assert client.replies(1) == [(1, bytes.fromhex("0600abcdef"))]


@pytest.mark.parametrize(
    "stray",
    [b"\r\n", b"\n", b"\x00\xff", b"01030000", b"GET / HTTP/1.1\r\n\r\n", b"x" * 10_000],
    ids=lambda stray: f"{len(stray)}-{stray[:12].hex()}",
)
def test_characters_before_a_colon_are_skipped(
    stray: bytes, appliance: Appliance, client: AsciiConnection
) -> None:
    client.send(stray + lines.ascii_frame(READ, 1) + stray + lines.ascii_frame(READ, 1))

    assert client.replies(2) == [(1, ZERO)] * 2
    assert client.is_quiet()
    assert counters(appliance)["frames"]["damaged"] == 0


@pytest.mark.parametrize(
    "damaged",
    [
        lines.ASCII.damaged(WRITE, 1),
        lines.ascii_frame(WRITE, 1)[:-4],
        lines.ascii_frame(WRITE, 1)[:-1],
        lines.ascii_frame(WRITE, 1)[:-2] + b"\n",
        b":",
        b":\r\n",
        b":01\r\n",
        b":0106\r\n",
        b":01FF\r\n",
        lines.ascii_frame(WRITE, 1).replace(b"1234", b"12g4"),
        lines.ascii_frame(WRITE, 1).replace(b"1234", b"12 34"),
        lines.ascii_frame(WRITE, 1).replace(b"1234", b"12\r\n34")[:-8],
        lines.ascii_frame(WRITE, 1).replace(b"1234", b"12\xff4"),
        lines.ascii_frame(WRITE, 1).replace(b"1234", b"123"),
        lines.ascii_frame(bytes.fromhex("080000") + bytes(251), 1),
        b":" + b"0" * 5_000 + b"\r\n",
        b":" + b"0" * 50_000,
    ],
    ids=lambda damaged: f"{len(damaged)}-{damaged[:24].hex()}",
)
def test_a_damaged_frame_is_counted_and_the_next_frame_is_served(
    damaged: bytes, appliance: Appliance, client: AsciiConnection
) -> None:
    client.send(damaged + lines.ascii_frame(READ, 1))

    assert client.replies(1) == [(1, ZERO)]
    assert client.is_quiet()
    assert counters(appliance)["frames"]["damaged"] == 1
    assert counters(appliance)["requests"] == {3: 1}
    assert not any(any(values) for values in content(appliance.memories["plant"]).values())


def test_each_colon_in_a_row_starts_a_frame_anew(
    appliance: Appliance, client: AsciiConnection
) -> None:
    client.send(b":" * 1000 + lines.ascii_frame(READ, 1))

    assert client.replies(1) == [(1, ZERO)]
    assert counters(appliance)["frames"]["damaged"] == 1000


def expected_of(stream: bytes) -> tuple[list[tuple[int, int]], int]:
    """The unit ids and function codes of the frames in a stream, and the number of damaged ones."""
    served, damaged, frame = [], 0, b""
    for character in (bytes([code]) for code in stream):
        if character == b":":
            damaged += bool(frame)
            frame = character
        elif frame:
            frame += character
            if frame.endswith(b"\r\n"):
                digits = frame[1:-2]
                whole = len(digits) % 2 == 0 and not set(digits) - DIGITS
                body = bytes.fromhex(digits.decode()) if whole else b""
                if len(body) >= 3 and not sum(body) & 0xFF:
                    served.append((body[0], body[1]))
                else:
                    damaged += 1
                frame = b""
            elif len(frame) == MAX_FRAME:
                damaged, frame = damaged + 1, b""
    return served, damaged


pieces = st.one_of(
    st.binary(max_size=40),
    st.text(":0123456789ABCDEFabcdef\r\n", max_size=40).map(str.encode),
    st.builds(lines.ascii_frame, st.binary(min_size=0, max_size=255), st.integers(0, 255)),
    st.builds(
        lambda pdu, cut: lines.ascii_frame(pdu, 1)[:cut],
        st.binary(min_size=1, max_size=253),
        st.integers(0, MAX_FRAME),
    ),
    st.integers(0, 6000).map(lambda length: b":" + b"0" * length),
)


@settings(max_examples=examples(200))
@given(garbage=st.lists(pieces, max_size=12), cut=st.integers(1, 3000))
def test_of_any_characters_exactly_the_frames_are_answered(
    garbage: list[bytes], cut: int, sturdy: Appliance
) -> None:
    # The request that is answered last; its colon ends a frame that is still open.
    stream = b"".join(garbage) + lines.ascii_frame(READ, 77)
    served, damaged = expected_of(stream)
    before = counters(sturdy)["frames"]["damaged"]
    with AsciiConnection(address(sturdy)) as client:
        for at in range(0, len(stream), cut):
            client.send(stream[at : at + cut])
        replies = client.replies(len(served))
        assert client.is_quiet()
    assert [(unit, reply[0] & 0x7F) for unit, reply in replies] == [
        (unit, code & 0x7F) for unit, code in served
    ]
    assert replies[-1] == (77, b"\x83\x0b")
    assert counters(sturdy)["frames"]["damaged"] - before == damaged


# The delimiter


@pytest.mark.parametrize("delimiter", b"\x00\n\r#0A:\x7f")
def test_the_delimiter_of_later_requests_can_be_changed(
    delimiter: int, appliance: Appliance, client: AsciiConnection
) -> None:
    change = bytes([8, 0, 3, delimiter, 0])
    assert client.ask(change) == change

    for _ in range(2):
        client.send(lines.ascii_frame(READ, 1)[:-1] + bytes([delimiter]))
        assert client.replies(1) == [(1, ZERO)]
    assert counters(appliance)["frames"]["damaged"] == 0


def test_a_changed_delimiter_applies_to_requests_that_arrived_with_the_change(
    appliance: Appliance, client: AsciiConnection
) -> None:
    change = bytes.fromhex("0800032300")
    changed = lines.ascii_frame(READ, 1)[:-1] + b"#"
    client.send(lines.ascii_frame(change, 1) + lines.ascii_frame(WRITE, 1) + changed)

    assert client.replies(2) == [(1, change), (1, ZERO)]
    assert appliance.memories["plant"].read("holding_registers", 0, 1) == [0]


def test_a_changed_delimiter_concerns_only_the_connection_that_changed_it(
    appliance: Appliance, client: AsciiConnection, connect: Connect
) -> None:
    other = connect(appliance)
    change = bytes.fromhex("0800032300")
    assert client.ask(change) == change

    assert other.ask(READ) == ZERO
    assert connect(appliance).ask(READ) == ZERO
    client.send(lines.ascii_frame(READ, 1)[:-1] + b"#")
    assert client.replies(1) == [(1, ZERO)]
    assert counters(appliance)["frames"]["damaged"] == 0


# Units and rules


def test_a_unit_that_no_rule_maps_fails_to_respond(client: AsciiConnection) -> None:
    for unit in (0, 2, 247, 255):
        assert client.ask(READ, unit) == b"\x83\x0b"
        assert client.ask(b"\x63", unit) == b"\xe3\x01"


def test_unit_0_is_an_ordinary_unit(run: Run, connect: Connect) -> None:
    rules = [{"sources": ["127.0.0.1"], "units": {0: "plant", 1: "other"}, "access": "read-write"}]
    appliance = run(configuration("ascii", rules=rules, memories={"plant": ALL, "other": ALL}))
    client = connect(appliance)

    assert client.ask(WRITE, 0) == WRITE
    assert client.ask(READ, 0) == bytes.fromhex("03021234")
    assert client.ask(READ, 1) == ZERO


@needs_127_0_0_2
def test_a_stranger_is_disconnected_and_counted(run: Run) -> None:
    appliance = run(configuration("ascii", rules=[rule(["127.0.0.1"])]))

    assert is_stranger("ascii", appliance, address(appliance), "127.0.0.2")
    assert counters(appliance)["requests"] == {}


# Timeouts and stop


@pytest.mark.parametrize("begun", [b":", lines.ascii_frame(WRITE, 1)[:-1]])
def test_half_a_request_ends_the_connection_after_the_request_timeout(
    begun: bytes, run: Run, connect: Connect
) -> None:
    appliance = run(configuration("ascii", request_timeout=0.2))
    client = connect(appliance)
    client.send(begun)

    assert client.rest() == b""
    wire.until(lambda: counters(appliance)["connections"]["request_timeout"] == 1, "it is counted")
    assert appliance.memories["plant"].read("holding_registers", 0, 1) == [0]


@pytest.mark.parametrize("sent", [b"no frame\r\n", lines.ASCII.damaged(READ, 1)])
def test_what_is_no_request_does_not_put_off_the_idle_timeout(
    sent: bytes, run: Run, connect: Connect
) -> None:
    appliance = run(configuration("ascii", idle_timeout=0.3))
    client = connect(appliance)

    def idle() -> bool:
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            client.send(sent)
        return bool(counters(appliance)["connections"]["idle"])

    wire.until(idle, "the connection ends")


def test_what_was_received_before_a_stop_is_answered(
    appliance: Appliance, client: AsciiConnection
) -> None:
    assert client.ask(READ) == ZERO
    client.send(framed([READ] * 100) + lines.ascii_frame(WRITE, 1)[:-1])
    appliance.stop()

    assert client.replies(100) == [(1, ZERO)] * 100
    assert client.rest() == b""


# Real clients


def test_pymodbus_reads_and_writes(run: Run) -> None:
    appliance = run(configuration("ascii", more={"identity": {"vendor_name": "Acme"}}))
    host, port = address(appliance)

    client = ModbusTcpClient(host, port=port, framer=FramerType.ASCII, **OPTIONS)
    with connected(client):
        tour(client, appliance.memories["plant"], 1)


def test_pymodbus_reads_and_writes_with_asyncio(run: Run) -> None:
    appliance = run(configuration("ascii", more={"identity": {"vendor_name": "Acme"}}))
    host, port = address(appliance)

    def made() -> AsyncModbusTcpClient:
        return AsyncModbusTcpClient(host, port=port, framer=FramerType.ASCII, **OPTIONS)

    with Patient(made) as client:
        tour(client, appliance.memories["plant"], 1)


def test_the_sync_client_reads_and_writes(appliance: Appliance) -> None:
    host, port = address(appliance)
    with holdfast.SyncClient(f"ascii+tcp://{host}:{port}", timeout=wire.DEADLINE) as plc:
        plc.write_registers(5, list(range(123)))
        assert plc.read_holding_registers(5, 123) == list(range(123))
        with pytest.raises(holdfast.ModbusException):
            plc.read_coils(1000, 1)


def test_the_client_reads_and_writes(appliance: Appliance) -> None:
    host, port = address(appliance)

    async def asked() -> list[bool]:
        async with holdfast.Client(f"ascii+tcp://{host}:{port}", timeout=wire.DEADLINE) as plc:
            await plc.write_coils(3, [True, False, True])
            return await plc.read_coils(3, 3)

    assert asyncio.run(asked()) == [True, False, True]
