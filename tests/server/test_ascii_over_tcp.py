"""ASCII frames in a TCP connection: a colon starts one, CR LF ends it."""

from __future__ import annotations

import contextlib
import struct
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support import lines, wire
from support.cases import examples
from support.running import content
from support.transports import (
    AsciiConnection,
    address,
    configuration,
    counters,
    rule,
    running,
)

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


# Pieces


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


# Timeouts


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
