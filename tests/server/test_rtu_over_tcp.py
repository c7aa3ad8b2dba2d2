"""RTU frames in a TCP connection: their length is in themselves, and silence empties the buffer."""

from __future__ import annotations

import contextlib
import random
import struct
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support import lines, wire
from support.cases import examples
from support.running import content
from support.transports import (
    NOT_OF_THEIR_LENGTH,
    TRANSPORTS,
    RtuConnection,
    address,
    configuration,
    counters,
    rule,
    running,
)
from support.vectors import cases

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
WRITE = bytes.fromhex("0600001234")

REQUESTS = [
    bytes.fromhex(text)
    for text in (
        "0100000009",
        "0200000009",
        "030000007d",
        "0400000002",
        "0500090000",
        "0600090102",
        "080000a537",
        "0b",
        "0f0003000902ff01",
        "1000000002040102 0304",
        "11",
        "16000400f20025",
        "170000000200010001 02beef",
        "2b0e0100",
        "63",
        "2b0d0100",
        "0300000000",
        "03ffff0002",
    )
]
"""Requests of every function, and some that are refused, whatever memory holds."""


def framed(pdus: list[bytes]) -> bytes:
    return b"".join(lines.rtu(pdu, 1) for pdu in pdus)


@pytest.fixture
def appliance(run: Run) -> Appliance:
    """Unit 1 is the memory plant. On a slow machine too, pieces of a request belong together."""
    return run(configuration("rtu", **PATIENT))


@pytest.fixture
def hasty(run: Run) -> Appliance:
    """The same, with the default `frame_timeout`."""
    return run(configuration("rtu"))


@pytest.fixture
def connect() -> Iterator[Callable[[Appliance], RtuConnection]]:
    with ExitStack() as opened:
        yield lambda to: opened.enter_context(RtuConnection(address(to)))


@pytest.fixture
def client(appliance: Appliance, connect: Callable[[Appliance], RtuConnection]) -> RtuConnection:
    return connect(appliance)


PATIENT = TRANSPORTS["rtu"].patient

SILENCE_S = 0.3
"""The time after which a request has no reply; a multiple of the `frame_timeout`."""


def ask_until_answered(client: RtuConnection) -> None:
    """Asks again and again until a reply comes, which may be late. All replies are right."""
    asked = 0
    while not client.comes(SILENCE_S):
        assert asked < 100
        client.send(lines.rtu(READ, 1))
        asked += 1
    while client.comes(0):
        assert client.replies(1) == [(1, ZERO)]


# Vectors


@pytest.mark.parametrize(
    "case",
    [case for case in cases("pdu.json") if case["name"] in NOT_OF_THEIR_LENGTH],
    ids=lambda case: case["name"],
)
def test_a_pdu_that_is_not_as_long_as_its_function_says_is_not_carried_out(
    case: dict[str, Any], run: Run, connect: Callable[[Appliance], RtuConnection]
) -> None:
    appliance = run(configuration("rtu"))
    client = connect(appliance)
    before = content(appliance.memories["plant"])
    client.send(lines.rtu(bytes.fromhex(case["request"]), 1))
    ask_until_answered(client)

    assert set(counters(appliance)["requests"]) == {3}
    assert content(appliance.memories["plant"]) == before


# Pieces


@pytest.fixture
def expected(client: RtuConnection) -> list[tuple[int, bytes]]:
    """The replies to REQUESTS, asked one by one, once they have written what they write."""
    return [[(1, client.ask(pdu)) for pdu in REQUESTS] for _ in range(2)][1]


def without_counters(replies: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    return [(unit, reply) for unit, reply in replies if reply[0] != 11]


@pytest.mark.parametrize("size", [*range(1, 12), 16, 50, 100, 1000])
def test_requests_may_arrive_in_pieces_of_any_size(
    size: int, client: RtuConnection, expected: list[tuple[int, bytes]]
) -> None:
    stream = framed(REQUESTS)
    for at in range(0, len(stream), size):
        client.send(stream[at : at + size])

    assert without_counters(client.replies(len(REQUESTS))) == without_counters(expected)
    assert client.is_quiet()


@pytest.fixture(scope="module")
def sturdy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    """An appliance for many examples."""
    with running(tmp_path_factory.mktemp("rtu"), configuration("rtu", **PATIENT)) as appliance:
        yield appliance


def test_the_longest_write_is_served(appliance: Appliance, client: RtuConnection) -> None:
    values = list(range(123))
    longest = struct.pack(">BHHB123H", 16, 5, 123, 246, *values)

    assert client.ask(longest) == longest[:5]
    assert appliance.memories["plant"].read("holding_registers", 5, 123) == values


# Frames that are not served


@pytest.mark.parametrize("pdu", REQUESTS[:14], ids=bytes.hex)
@pytest.mark.parametrize("bit", [0, 7, 8, 15])
def test_a_wrong_crc_is_passed_over_and_the_next_frame_is_served(
    pdu: bytes, bit: int, appliance: Appliance, client: RtuConnection
) -> None:
    damaged = bytearray(lines.rtu(pdu, 1))
    damaged[-2 + bit // 8] ^= 1 << bit % 8
    client.send(bytes(damaged) + lines.rtu(READ, 1))

    assert client.replies(1) == [(1, ZERO)]
    assert client.is_quiet()
    assert counters(appliance)["frames"]["damaged"] == 1
    assert counters(appliance)["requests"] == {3: 1}
    assert not any(any(values) for values in content(appliance.memories["plant"]).values())


@pytest.mark.parametrize("code", [0, 9, 10, 0x13, 0x19, 0x2A, 0x2C, 0x63, 0x64, 0x7F, 0x80, 0xFF])
@pytest.mark.parametrize("length", [0, 1, 2, 5, 100, 252])
def test_an_unknown_function_of_any_length_is_an_illegal_function(
    code: int, length: int, client: RtuConnection
) -> None:
    data = random.Random(length).randbytes(length)
    client.send(lines.rtu(bytes([code]) + data, 1) + lines.rtu(READ, 1))

    assert client.replies(2) == [(1, bytes([code | 0x80, 1])), (1, ZERO)]
    assert client.is_quiet()


@pytest.mark.parametrize("text", ["07", "0c", "140706000400010002", "15020600", "1804de"])
def test_a_function_of_the_standard_that_is_not_served_is_an_illegal_function(
    text: str, client: RtuConnection
) -> None:
    pdu = bytes.fromhex(text)
    client.send(lines.rtu(pdu, 1) + lines.rtu(READ, 1))

    assert client.replies(2) == [(1, bytes([pdu[0] | 0x80, 1])), (1, ZERO)]


@pytest.mark.parametrize("unit", range(1, 21))
def test_an_unknown_function_whose_crc_fits_too_early_does_not_upset_the_next_frame(
    unit: int, run: Run, connect: Callable[[Appliance], RtuConnection]
) -> None:
    client = connect(run(configuration("rtu", rules=[rule(["127.0.0.1"], unit)])))
    # The last byte of data is the first of the CRC of those before it.
    pdu = b"\x63\x01" + lines.crc(bytes([unit]) + b"\x63\x01")[:1]
    client.send(lines.rtu(pdu, unit) + lines.rtu(READ, unit))

    assert client.replies(2) == [(unit, b"\xe3\x01"), (unit, ZERO)]


def test_a_frame_for_unit_0_behind_an_unknown_function_is_served(
    run: Run, connect: Callable[[Appliance], RtuConnection]
) -> None:
    client = connect(run(configuration("rtu", rules=[rule(["127.0.0.1"], 0)])))
    client.send(lines.rtu(b"\x63", 0) + lines.rtu(READ, 0))

    assert client.replies(2) == [(0, b"\xe3\x01"), (0, ZERO)]


@pytest.mark.parametrize(
    "stream",
    [
        b"\x01\x10\x00\x00\x00\x7e\xfc",
        b"\x01\x10\x00\x00\x00\x7f\xff",
        b"\x01\x0f\x00\x00\x07\xf8\xff",
        b"\x01\x17\x00\x00\x00\x01\x00\x00\x00\x7f\xfe",
        b"\x01\x14\xff",
        b"\x01\x63" + b"\xaa" * 300,
    ],
    ids=lambda stream: stream[:12].hex(),
)
def test_a_frame_longer_than_any_is_passed_over(
    stream: bytes, hasty: Appliance, connect: Callable[[Appliance], RtuConnection]
) -> None:
    client = connect(hasty)
    client.send(lines.rtu(READ, 1) + stream)
    assert client.replies(1) == [(1, ZERO)]

    ask_until_answered(client)
    assert counters(hasty)["frames"]["damaged"] == 1


@pytest.mark.parametrize("stray", ["00", "ff", "01", "0103", "0110", "016300", "00" * 40])
def test_stray_bytes_before_a_request_cost_one_request_at_most(
    stray: str, hasty: Appliance, connect: Callable[[Appliance], RtuConnection]
) -> None:
    client = connect(hasty)
    client.send(bytes.fromhex(stray))
    for _ in range(30):
        client.send(lines.rtu(READ, 1))
        client.comes(SILENCE_S)

    assert client.replies(29) == [(1, ZERO)] * 29
    assert counters(hasty)["frames"]["damaged"] >= 1


def test_the_data_of_a_damaged_write_are_not_carried_out(
    hasty: Appliance, connect: Callable[[Appliance], RtuConnection]
) -> None:
    client = connect(hasty)
    inner = lines.rtu(WRITE, 1)
    damaged = bytearray(lines.rtu(struct.pack(">BHHB", 16, 5, 4, 8) + inner, 1))
    damaged[-1] ^= 1
    client.send(bytes(damaged))
    ask_until_answered(client)

    assert set(counters(hasty)["requests"]) == {3}
    assert not any(any(values) for values in content(hasty.memories["plant"]).values())


def test_the_rest_of_a_request_may_not_come_after_a_silence(
    hasty: Appliance, connect: Callable[[Appliance], RtuConnection]
) -> None:
    client = connect(hasty)
    frame = lines.rtu(WRITE, 1)
    client.send(frame[:5])
    wire.until(lambda: counters(hasty)["frames"]["damaged"] == 1, "the silence has ended it")
    client.send(frame[5:])
    wire.until(lambda: counters(hasty)["frames"]["damaged"] == 2, "and again")

    assert client.ask(READ) == ZERO
    assert client.is_quiet()


BEGUN = bytes.fromhex("01100000007bf6")
"""A write of 123 registers, of which nothing more comes."""


def test_a_request_that_a_begun_one_swallowed_is_never_answered(
    hasty: Appliance, connect: Callable[[Appliance], RtuConnection]
) -> None:
    hasty.memories["plant"].write("holding_registers", 0, [100, 200])
    client = connect(hasty)
    client.send(BEGUN + lines.rtu(bytes.fromhex("0300000001"), 1))
    wire.until(lambda: counters(hasty)["frames"]["damaged"] == 1, "the silence has ended it")
    client.send(lines.rtu(bytes.fromhex("0300010001"), 1))

    assert client.replies(1) == [(1, bytes.fromhex("030200c8"))]
    assert client.is_quiet()
    assert counters(hasty)["requests"] == {3: 1}


def test_requests_that_a_begun_one_swallows_for_long_are_never_answered(
    appliance: Appliance, client: RtuConnection
) -> None:
    """Without a silence, the begun write ends where its byte count says, between two requests."""
    client.send(BEGUN)
    for count in range(1, 33):
        client.send(lines.rtu(struct.pack(">BHH", 3, 0, count), 1))

    [(unit, reply)] = client.replies(1)
    assert (unit, reply[:2]) == (1, b"\x03\x40")
    assert client.is_quiet()
    assert counters(appliance)["frames"]["damaged"] == 1


def test_noise_without_a_silence_ends_the_connection_after_the_request_timeout(
    run: Run, connect: Callable[[Appliance], RtuConnection]
) -> None:
    timeouts: dict[str, Any] = {"request_timeout": 0.2, "frame_timeout": wire.DEADLINE}
    appliance = run(configuration("rtu", **timeouts))
    client = connect(appliance)

    def ended() -> bool:
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            client.send(b"\x01\x14\xff")
        return bool(counters(appliance)["connections"]["request_timeout"])

    wire.until(ended, "the connection ends")


@settings(max_examples=examples(50))
@given(garbage=st.binary(max_size=2000))
def test_no_bytes_end_the_service(garbage: bytes, sturdy: Appliance) -> None:
    with RtuConnection(address(sturdy)) as noisy:
        with contextlib.suppress(OSError):
            noisy.send(garbage)
            noisy.finish()
        noisy.rest()
    with RtuConnection(address(sturdy)) as client:
        assert client.ask(b"\x11")[0] == 17


# Timeouts


def test_an_unknown_function_whose_crc_never_fits_ends_after_the_request_timeout(
    run: Run, connect: Callable[[Appliance], RtuConnection]
) -> None:
    appliance = run(configuration("rtu", request_timeout=0.2, frame_timeout=10))
    client = connect(appliance)
    client.send(b"\x01\x63\x00\x00\x00")

    assert client.rest() == b""
    wire.until(lambda: counters(appliance)["connections"]["request_timeout"] == 1, "it is counted")


def test_damaged_frames_do_not_put_off_the_idle_timeout(
    run: Run, connect: Callable[[Appliance], RtuConnection]
) -> None:
    appliance = run(configuration("rtu", idle_timeout=0.3))
    client = connect(appliance)

    def idle() -> bool:
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            client.send(lines.RTU.damaged(READ, 1))
        return bool(counters(appliance)["connections"]["idle"])

    wire.until(idle, "the connection ends")
