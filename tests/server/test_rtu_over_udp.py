"""RTU over UDP: a datagram is a request if it is exactly one frame; anything else gets no reply."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support import lines, wire
from support.cases import examples
from support.running import content
from support.transports import (
    RtuDatagrams,
    address,
    configuration,
    counters,
    rule,
    running,
)

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
def test_of_any_datagrams_exactly_the_requests_are_answered(
    garbage: list[bytes], sturdy: Appliance
) -> None:
    damaged = counters(sturdy)["frames"]["damaged"]
    with RtuDatagrams(address(sturdy)) as client:
        for datagram in garbage:
            client.send(datagram)
        client.send(lines.rtu(READ, 77))
        sent = [*garbage, lines.rtu(READ, 77)]
        asked = [each for each in sent if is_frame(each) and each[1] < 0x80]
        replies = [client.receive() for _ in asked]
        assert client.is_quiet()
    for datagram, reply in zip(asked, replies, strict=True):
        assert (reply.unit, reply.pdu[0] & 0x7F) == (datagram[0], datagram[1] & 0x7F)
    assert replies[-1].pdu == b"\x83\x0b"
    told = counters(sturdy)["frames"]["damaged"] - damaged
    assert told == sum(not is_frame(datagram) for datagram in garbage)
