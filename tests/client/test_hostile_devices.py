"""The client against devices that lie, break off, are silent or too late.

Each misdeed gives its error in time, for the client that waits and for the one that awaits; the
next call works; no request is sent twice.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import holdfast
from support import lines, wire
from support.cases import examples
from support.certificates import Certificates
from support.faces import FACES, Dial, connected, dialling, run
from support.fake_device import (
    DATAGRAMS,
    LINES,
    STREAMS,
    Asked,
    Connection,
    ScriptedDevice,
    Sender,
    Serial,
    Stream,
    Udp,
    good,
    silent,
)
from support.machine import missing, tool

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from support.faces import Face
    from support.fake_device import Behaviour

SHORT = 0.1
"""A timeout that is waited for."""


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


class Make:
    """Makes devices that stop when the test ends."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack = stack
        self._folder = folder
        self._number = itertools.count()

    def __call__(self, kind: str, *script: Behaviour, **options: Any) -> ScriptedDevice:
        return self._stack.enter_context(self._made(kind, script, options))

    def _made(
        self, kind: str, script: tuple[Behaviour, ...], options: dict[str, Any]
    ) -> ScriptedDevice:
        if kind in LINES:
            mode = lines.RTU if kind == "rtu" else lines.ASCII
            return Serial(mode, self._folder / f"line{next(self._number)}", *script, **options)
        if kind in DATAGRAMS:
            return Udp(*script, kind=kind, **options)
        return Stream(kind, *script, **options)


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    with ExitStack() as stack:
        yield Make(stack, tmp_path)


def connections(device: ScriptedDevice) -> int:
    assert isinstance(device, Stream)
    return device.connections


def close(asked: Asked) -> None:
    assert isinstance(asked.peer, Connection)
    asked.peer.close()


def reset(asked: Asked) -> None:
    assert isinstance(asked.peer, Connection)
    asked.peer.reset()


def replies(hexadecimal: str, **header: int) -> Behaviour:
    """Answers with a PDU."""
    return lambda asked: asked.answer(bytes.fromhex(hexadecimal), **header)


def header(**lies: int) -> Behaviour:
    """Answers with lies in the header of Modbus TCP."""
    return lambda asked: asked.send(wire.frame(asked.reply, 1, asked.transaction, **lies))


def half(then: Behaviour) -> Behaviour:
    """Sends half a reply, then does something."""

    def behave(asked: Asked) -> None:
        frame = asked.frame()
        asked.send(frame[: len(frame) // 2])
        then(asked)

    return behave


# What is no reply: the tests read registers 7 and 8, whose reply is 03 04 0007 0008

WRONG_PDUS = {
    "another function": ("0404 0007 0008", "function code 0x04, expected 0x03"),
    "a register too few": ("0302 0007", "length"),
    "a register too many": ("0306 0007 0008 0009", "length"),
    "a byte count too small": ("0302 0007 0008", "length"),
    "a byte count too large": ("0306 0007 0008", "length"),
    "an odd byte count": ("0303 0007 08", "length"),
    "a byte too many": ("0304 0007 0008 00", "length"),
    "no data": ("03", "length"),
    "an exception of another function": ("8402", "function code 0x84, expected 0x03"),
    "an exception without a code": ("83", "length"),
    "an exception and more": ("8302 00", "length"),
    "the request itself": ("0300 0700 02", "length"),
    "an unknown function": ("6e", "function code 0x6e, expected 0x03"),
}

TCP_ONLY: dict[str, tuple[Behaviour, str]] = {
    "another transaction id": (
        lambda asked: asked.answer(transaction=asked.transaction ^ 1),
        r"transaction id \d+ matches no request",
    ),
    "another unit": (lambda asked: asked.answer(unit=2), "from unit 2 to a request to unit 1"),
    "protocol id 1": (header(protocol=1), "protocol id 1, expected 0"),
    "length 0": (header(length=0), "length 0"),
    "length 1": (header(length=1), "length 1"),
    "length 255": (header(length=255), "length 255"),
    "length 65535": (header(length=65535), "length 65535"),
    "length too small": (header(length=4), "length"),
    "another protocol": (lambda asked: asked.send(b"HTTP/1.1 400 Bad Request\r\n\r\n"), "header"),
    "without an end": (lambda asked: asked.send(b"\0" * 1_000_000), "length 0"),
    "a good reply too late": (
        lambda asked: asked.send(asked.frame(transaction=9) + asked.frame()),
        "transaction id 9",
    ),
}


def invalid_then_good(
    make: Callable[[], ScriptedDevice],
    dial: Dial,
    text: str = "invalid response",
    timeout: float = wire.DEADLINE,
) -> None:
    """The next call after what is no reply has a new connection."""

    def is_refused(timeout: float) -> bool:
        device = make()
        client = dial(device.url, timeout=timeout)
        try:
            with pytest.raises(holdfast.InvalidResponse, match=text):
                client.read_holding_registers(7, 2)
        except holdfast.RequestTimeout:
            return False
        client.timeout = wire.DEADLINE
        assert client.read_holding_registers(8, 2) == [8, 9]
        assert len(device.requests) == 2
        if isinstance(device, Stream):
            assert device.connections == 2
        return True

    wire.until_long_enough(is_refused, "what is no reply comes", timeout)


@pytest.mark.parametrize("lie", WRONG_PDUS)
def test_a_pdu_that_is_no_reply_ends_a_tcp_connection(lie: str, make: Make, dial: Dial) -> None:
    pdu, text = WRONG_PDUS[lie]
    invalid_then_good(lambda: make("tcp", replies(pdu)), dial, text)


@pytest.mark.parametrize("lie", TCP_ONLY)
def test_a_frame_that_is_no_reply_ends_a_tcp_connection(lie: str, make: Make, dial: Dial) -> None:
    behaviour, text = TCP_ONLY[lie]
    invalid_then_good(lambda: make("tcp", behaviour), dial, text)


# Not so long that more bytes are waited for than come. The request itself is an echo.
RTU_PDUS = {
    lie: pdu
    for lie, (pdu, _) in WRONG_PDUS.items()
    if lie
    not in (
        "no data",
        "a byte count too large",
        "an exception without a code",
        "the request itself",
    )
}


def damaged(asked: Asked) -> None:
    mode = lines.ASCII if asked.raw.startswith(b":") else lines.RTU
    asked.send(mode.damaged(asked.reply, asked.unit))


RTU_FRAMES: dict[str, Behaviour] = {
    "another unit": lambda asked: asked.answer(unit=2),
    "a wrong check sum": damaged,
    "noise": lambda asked: asked.send(b"\xff\x00\xff\x00\xff\x00\xff\x00"),
    "without an end": lambda asked: asked.send(b"\0" * 100_000),
}


STRAY = ("noise", "an unknown function")
"""A reply may follow these: they are refused when the timeout ends."""


def patience(kind: str, lie: str) -> float:
    return SHORT if kind != "ascii" and lie in STRAY else wire.DEADLINE


@pytest.mark.parametrize("lie", [*RTU_PDUS, *RTU_FRAMES])
@pytest.mark.parametrize("kind", ["rtu+tcp", "rtu+udp"])
def test_what_is_no_reply_ends_a_connection_with_rtu_frames(
    kind: str, lie: str, make: Make, dial: Dial
) -> None:
    behaviour = RTU_FRAMES[lie] if lie in RTU_FRAMES else replies(RTU_PDUS[lie])
    if (kind, lie) == ("rtu+udp", "without an end"):
        behaviour = lambda asked: asked.send(b"\0" * 60_000)  # noqa: E731
    invalid_then_good(lambda: make(kind, behaviour), dial, timeout=patience(kind, lie))


@pytest.mark.parametrize("kind", ["rtu+tcp", "rtu+udp", *LINES])
def test_the_request_itself_is_an_echo_and_no_reply(kind: str, make: Make, dial: Dial) -> None:
    def is_echoed(timeout: float) -> bool:
        device = make(kind, lambda asked: asked.send(asked.raw))
        client = dial(device.url, timeout=timeout)

        with pytest.raises(holdfast.RequestTimeout):
            client.read_holding_registers(7, 2)
        if not device.requests:
            return False
        # One echo does not make the adapter one that repeats everything.
        client.timeout = wire.DEADLINE
        for address in range(8, 12):
            assert client.read_holding_registers(address, 2) == [address, address + 1]
        assert len(device.requests) == 5
        return True

    wire.until_long_enough(is_echoed, "the request comes")


@pytest.mark.parametrize("kind", ["rtu+tcp", "rtu+udp", "rtu"])
@pytest.mark.parametrize("noise", [b"\0", b"\xff\xfe\xfd", b"\1\4\0\0\0", b"\2\3\2\0\0"])
def test_stray_bytes_before_an_rtu_reply_are_skipped(
    kind: str, noise: bytes, make: Make, dial: Dial
) -> None:
    device = make(kind, then=lambda asked: asked.send(noise + asked.frame()))
    client = dial(device.url)

    assert client.read_holding_registers(7, 2) == [7, 8]
    assert client.read_holding_registers(8, 2) == [8, 9]
    if kind == "rtu+tcp":
        assert connections(device) == 1


@pytest.mark.parametrize("lie", [*RTU_PDUS, "another unit", "a wrong check sum", "noise"])
@pytest.mark.parametrize("kind", LINES)
def test_what_is_no_reply_leaves_a_line_usable(kind: str, lie: str, make: Make, dial: Dial) -> None:
    behaviour = RTU_FRAMES[lie] if lie in RTU_FRAMES else replies(RTU_PDUS[lie])
    if (kind, lie) == ("ascii", "noise"):
        behaviour = lambda asked: asked.send(b":0102\xff\r\n")  # noqa: E731
    invalid_then_good(lambda: make(kind, behaviour), dial, timeout=patience(kind, lie))


def test_characters_before_an_ascii_frame_are_passed_over(make: Make, dial: Dial) -> None:
    device = make("ascii", lambda asked: asked.send(b"\xff:0103" + asked.frame()))

    assert dial(device.url).read_holding_registers(7, 2) == [7, 8]


def test_characters_without_an_end_are_no_ascii_frame(make: Make, dial: Dial) -> None:
    invalid_then_good(
        lambda: make("ascii", lambda asked: asked.send(b":" + b"0" * 3000)), dial, "more"
    )


@pytest.mark.parametrize(
    ("sent_back", "text"),
    [
        ("06 0003 0008", "does not repeat the values"),
        ("06 0004 0007", "does not repeat the values"),
        ("06 0003", "length"),
        ("10 0003 0007", "function code 0x10"),
    ],
)
def test_a_write_is_done_when_the_device_says_the_same(
    sent_back: str, text: str, make: Make, dial: Dial
) -> None:
    device = make("tcp", replies(sent_back))
    client = dial(device.url)

    with pytest.raises(holdfast.InvalidResponse, match=text):
        client.write_register(3, 7)
    client.write_register(3, 7)

    assert len(device.requests) == 2


# Identification

OBJECTS = "00 00 02"
"""Level 1, nothing follows, two objects: of which replies below make a mess."""


@pytest.mark.parametrize(
    ("reply", "text"),
    [
        ("2b0e 03 01 ff 00 01 00 01 41", "object 0 can't follow object 0"),
        ("2b0e 03 01 ff 05 00", "object 5 can't follow object 0"),
        ("2b0e 03 01 00 00 02 00 01 41", "length"),
        ("2b0e 03 01 00 00 01 00 02 41", "length"),
        ("2b0e 03 01 01 00 01 00 01 41", "length"),
        ("2b0e 01 01 00 00 01 00 01 41", "length"),
        ("2b0d 03 01 00 00 01 00 01 41", "length"),
    ],
)
def test_an_identification_that_makes_no_sense_is_refused(
    reply: str, text: str, make: Make, dial: Dial
) -> None:
    device = make("tcp", replies(reply))
    with pytest.raises(holdfast.InvalidResponse, match=text):
        dial(device.url).identify()
    assert len(device.requests) == 1


def test_an_identification_ends_though_a_device_always_has_more(make: Make, dial: Dial) -> None:
    def more(asked: Asked) -> None:
        following = min(asked.pdu[3] + 1, 255)
        asked.answer(bytes([0x2B, 0x0E, 3, 1, 0xFF, following, 1, asked.pdu[3], 1, 65]))

    device = make("tcp", then=more)
    with pytest.raises(holdfast.InvalidResponse, match="object 255 can't follow object"):
        dial(device.url, timeout=3 * wire.DEADLINE).identify()  # For all 256 requests.
    assert len(device.requests) == 256


def test_a_device_of_a_lower_level_is_asked_for_less(make: Make, dial: Dial) -> None:
    basic = "2b0e 01 01 00 00 03 00 01 41 01 01 42 02 01 43"
    device = make("tcp", replies("ab03"), replies("ab03"), replies(basic))

    who = dial(device.url).identify()

    assert (who.vendor_name, who.product_code, who.revision) == ("A", "B", "C")
    assert (who.product_name, who.conformity_level) == (None, 1)
    assert [asked.pdu[2] for asked in device.requests] == [3, 2, 1]


BASIC = "2b0e 0{} 01 00 00 03 00 01 41 01 01 42 02 01 43"
"""The three mandatory objects, in reply to a read code."""


@pytest.mark.parametrize("refusal", ["ab02", "ab03"])
@pytest.mark.parametrize("codes", [[3, 2], [3, 2, 1]])
def test_a_device_is_identified_by_the_read_codes_that_it_has(
    refusal: str, codes: list[int], make: Make, dial: Dial
) -> None:
    *refused, known = codes
    device = make("tcp", *[replies(refusal)] * len(refused), replies(BASIC.format(known)))

    who = dial(device.url).identify()

    assert (who.vendor_name, who.product_code, who.revision) == ("A", "B", "C")
    assert [asked.pdu[2] for asked in device.requests] == codes


def test_mandatory_objects_that_a_stream_lacks_are_read_by_lower_read_codes(
    make: Make, dial: Dial
) -> None:
    extended = "2b0e 03 83 00 00 01 80 01 58"
    regular = "2b0e 02 02 00 00 01 04 01 44"
    device = make("tcp", replies(extended), replies(regular), replies(BASIC.format(1)))

    who = dial(device.url).identify()

    assert who.objects == {0x80: b"X", 4: b"D", 0: b"A", 1: b"B", 2: b"C"}
    assert (who.product_name, who.vendor_name, who.conformity_level) == ("D", "A", 0x83)
    assert [asked.pdu[2] for asked in device.requests] == [3, 2, 1]


def test_a_device_without_all_mandatory_objects_is_identified_by_those_it_has(
    make: Make, dial: Dial
) -> None:
    vendor = "2b0e 03 01 00 00 01 00 01 41"
    device = make("tcp", replies(vendor), replies("ab03"), replies("ab02"))

    assert dial(device.url).identify().objects == {0: b"A"}
    assert len(device.requests) == 3


@pytest.mark.parametrize("failure", ["ab01", "ab04", "2b0e 03 01 00 00 01 00 01 41"])
def test_what_a_device_has_said_stands_though_lower_read_codes_fail(
    failure: str, make: Make, dial: Dial
) -> None:
    device = make("tcp", replies("2b0e 03 01 00 00 01 00 01 41"), then=replies(failure))

    assert dial(device.url).identify().objects == {0: b"A"}


@pytest.mark.parametrize(("reply", "requests"), [("ab01", 1), ("ab02", 3), ("ab03", 3)])
def test_a_device_may_know_no_identification(
    reply: str, requests: int, make: Make, dial: Dial
) -> None:
    device = make("tcp", then=replies(reply))
    with pytest.raises(holdfast.ModbusException):
        dial(device.url).identify()
    assert len(device.requests) == requests


# Exceptions


@pytest.mark.parametrize(
    ("code", "name"),
    [
        (1, "Illegal Function"),
        (2, "Illegal Data Address"),
        (3, "Illegal Data Value"),
        (4, "Server Device Failure"),
        (5, "Acknowledge"),
        (6, "Server Device Busy"),
        (8, "Memory Parity Error"),
        (10, "Gateway Path Unavailable"),
        (11, "Gateway Target Device Failed To Respond"),
        (0, "unknown"),
        (7, "unknown"),
        (255, "unknown"),
    ],
)
def test_an_exception_is_told_by_code_and_name(
    code: int, name: str, make: Make, dial: Dial
) -> None:
    device = make("tcp", replies(f"83{code:02x}"))
    client = dial(device.url)

    with pytest.raises(holdfast.ModbusException) as caught:
        client.read_holding_registers(7, 2)

    assert (caught.value.code, caught.value.name) == (code, name)
    assert str(caught.value) == f"exception {code:02X} ({name})"
    assert client.read_holding_registers(8, 1) == [8]
    assert connections(device) == 1


@pytest.mark.parametrize("kind", ["rtu+tcp", "udp", *LINES])
def test_an_exception_leaves_any_transport_usable(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, replies("8302"), replies("8355"))
    client = dial(device.url)

    for code in (2, 0x55):
        with pytest.raises(holdfast.ModbusException) as caught:
            client.read_holding_registers(7, 2)
        assert caught.value.code == code
    assert client.read_holding_registers(8, 1) == [8]
    assert len(device.requests) == 3
    if kind == "rtu+tcp":
        assert connections(device) == 1


# Pieces


@pytest.mark.parametrize("kind", [*STREAMS, *LINES])
def test_a_reply_may_come_byte_by_byte(kind: str, make: Make, dial: Dial) -> None:
    def drip(asked: Asked) -> None:
        asked.drip(asked.frame())

    client = dial(make(kind, then=drip).url)

    assert client.read_holding_registers(7, 2) == [7, 8]
    client.write_registers(7, [1, 2])
    assert client.read_holding_registers(7, 2) == [1, 2]


# Before


@pytest.mark.parametrize("kind", LINES)
def test_what_came_before_a_line_was_opened_is_discarded(kind: str, make: Make) -> None:
    device = make(kind)
    assert isinstance(device, Serial)
    mode = lines.RTU if kind == "rtu" else lines.ASCII
    os.write(device.terminal.end, mode.frame(bytes.fromhex("0302 0009"), 1))
    wire.until(lambda: device.terminal.waiting() > 0, "the frame has come")
    bytes_by_way: list[str] = []

    with holdfast.SyncClient(device.url, trace=lambda way, _: bytes_by_way.append(way)) as plc:
        assert plc.read_holding_registers(7, 1) == [7]

    assert bytes_by_way[0] == "sent"


# Ends


ENDS: dict[str, Behaviour] = {
    "closed before the reply": close,
    "closed amid the reply": half(close),
    "reset before the reply": reset,
    "reset amid the reply": half(reset),
}


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("kind", STREAMS)
def test_a_connection_that_ends_is_lost_and_made_anew(
    kind: str, end: str, make: Make, dial: Dial
) -> None:
    device = make(kind, ENDS[end])
    client = dial(device.url)

    with pytest.raises(holdfast.ConnectionLost, match=r"^connection lost: "):
        client.read_holding_registers(7, 2)

    assert client.read_holding_registers(8, 2) == [8, 9]
    assert (connections(device), len(device.requests)) == (2, 2)


@pytest.mark.parametrize("end", [close, reset])
@pytest.mark.parametrize("kind", STREAMS)
def test_what_ends_a_connection_behind_a_reply_does_not_matter(
    kind: str, end: Behaviour, make: Make, dial: Dial
) -> None:
    def reply_and_end(asked: Asked) -> None:
        asked.answer()
        asked.peer.received = b""
        end(asked)

    device = make(kind, lambda asked: asked.answer(), reply_and_end)
    client = dial(device.url)
    assert client.read_holding_registers(6, 1) == [6]
    assert client.read_holding_registers(7, 1) == [7]
    ended = time.monotonic()
    # After so much time without use a connection is looked at before it is used.
    wire.until(lambda: time.monotonic() > ended + 0.06, "the connection is idle")

    assert client.read_holding_registers(8, 1) == [8]
    assert connections(device) == 2
    # A reset may overtake the reply before it: then that read is sent again.
    assert len(device.requests) in ((3,) if end is close else (3, 4))


@pytest.mark.parametrize("end", ["close", "reset"])
@pytest.mark.parametrize("kind", STREAMS)
def test_a_connection_may_end_as_soon_as_it_is_made(
    kind: str, end: str, make: Make, dial: Dial
) -> None:
    def greet(peer: Connection, number: int) -> None:
        if number == 1:
            getattr(peer, end)()

    device = make(kind, greet=greet)
    client = dial(device.url)

    with pytest.raises(holdfast.ConnectionLost):
        client.read_holding_registers(7, 2)
    assert client.read_holding_registers(8, 2) == [8, 9]
    assert connections(device) == 2


def test_a_connection_that_begins_with_noise_is_ended(make: Make, dial: Dial) -> None:
    def greet(peer: Connection, number: int) -> None:
        if number <= 5:
            peer.send(b"Welcome to the terminal server!\r\n")

    device = make("tcp", greet=greet)
    client = dial(device.url)

    for _ in range(5):
        with pytest.raises(holdfast.InvalidResponse):
            client.read_holding_registers(7, 2)
    assert client.read_holding_registers(8, 2) == [8, 9]
    assert connections(device) == 6


ALONE = """
import asyncio, fcntl, socket, struct, sys
import holdfast
from holdfast import _core
from holdfast.client import endpoint, url
with socket.socket() as each:
    fcntl.ioctl(each, 0x8914, struct.pack("16sH22x", b"lo", 1))  # Up.
with open("/proc/sys/net/ipv4/ip_local_port_range", "w") as ports:
    ports.write("40000 40000")
print("alone", flush=True)

async def write(at):
    async with holdfast.Client(at, timeout=60) as plc:
        await plc.write_register(0, 1)

def write_sync(at):
    with holdfast.SyncClient(at, timeout=60) as plc:
        plc.write_register(0, 1)

def write_by_link(at):
    poller, caller = _core.Poller([]), _core.Caller()
    with socket.socket(fileno=caller.detach()) as ended:
        link = poller.link(endpoint.endpoint(url.parse(at)))
        link.call(caller, _core.Request.write_register(0, 1), 1, 60)
        ended.setblocking(True)
        ended.recv(1)
    [(_, _, result)] = caller.take()
    poller.stop()
    if isinstance(result, Exception):
        raise result

for at in ("tcp", "rtu+tcp", "udp"):
    for call in (lambda at: asyncio.run(write(at)), write_sync, write_by_link):
        try:
            call(at + "://127.0.0.1:40000")
            print("confirmed")
        except holdfast.ConnectFailed as error:
            print(error.detail.lower())
for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
    with socket.socket(type=kind) as device:
        device.bind(("127.0.0.1", 40000))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has network namespaces")
def test_a_client_whose_port_the_system_takes_from_the_device_does_not_answer_itself() -> None:
    """Nobody listens at the only port of a network that the system has for clients."""
    command = [tool("unshare"), "--map-root-user", "--net", sys.executable, "-c", ALONE]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=wire.DEADLINE)
    if not ran.stdout:
        missing(f"the right to make a network namespace ({ran.stderr})")
    assert ran.stdout.split("\n") == ["alone", *["connection refused"] * 9, ""], ran.stderr
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("kind", STREAMS)
def test_a_refused_connection_is_tried_again_by_the_next_call(kind: str, dial: Dial) -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        client = dial(f"{kind}://127.0.0.1:{nobody.getsockname()[1]}")
        for _ in range(2):
            with pytest.raises(holdfast.ConnectionLost, match=r"can't connect to .*127\.0\.0\.1:"):
                client.read_coils(0, 1)
        nobody.listen()
        client.timeout = SHORT
        with pytest.raises(holdfast.RequestTimeout):
            client.read_coils(0, 1)


def test_a_name_that_can_be_none_is_no_host(dial: Dial) -> None:
    with pytest.raises(ValueError, match=r"the host is 'a*'…, allowed: a host name"):
        dial("tcp://" + "a" * 64)


@pytest.mark.parametrize("kind", STREAMS)
def test_a_connection_that_cannot_be_made_in_time_is_given_up(kind: str, dial: Dial) -> None:
    with socket.socket() as full, ExitStack() as queue:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        for _ in range(3):
            waiting = queue.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(full.getsockname())
        client = dial(f"{kind}://127.0.0.1:{full.getsockname()[1]}", timeout=SHORT)
        began = time.monotonic()
        with pytest.raises(holdfast.RequestTimeout, match=f"within {SHORT} s"):
            client.read_coils(0, 1)
        assert SHORT <= time.monotonic() - began < wire.DEADLINE


# Silence


SILENCES: dict[str, Behaviour] = {
    "nothing": silent,
    "half a reply": half(silent),
    "a byte": lambda asked: asked.send(asked.frame()[:1]),
    "all but a byte": lambda asked: asked.send(asked.frame()[:-1]),
}


@pytest.mark.parametrize("silence", SILENCES)
@pytest.mark.parametrize("kind", [*STREAMS, *LINES])
def test_a_reply_that_does_not_come_times_out(
    kind: str, silence: str, make: Make, dial: Dial
) -> None:
    def is_in_time(timeout: float) -> bool:
        sent_at = inf

        def behave(asked: Asked) -> None:
            nonlocal sent_at
            SILENCES[silence](asked)
            sent_at = time.monotonic()

        device = make(kind, good, behave)
        client = connected(dial, device.url, timeout)
        began = time.monotonic()

        text = f"^no (complete )?reply within {timeout} s(, only its start)?$"
        with pytest.raises(holdfast.RequestTimeout, match=text):
            client.write_register(7, 70)

        assert timeout <= time.monotonic() - began < wire.DEADLINE
        if sent_at > began + timeout:
            return False
        client.timeout = wire.DEADLINE
        assert client.read_holding_registers(8, 2) == [8, 9]
        assert len(device.requests) == 3
        if kind in STREAMS:
            # Over TCP a late reply is known by its id. Where it is not, or where a reply broke off,
            # the next call has a connection of its own.
            same = kind == "tcp" and silence == "nothing"
            assert connections(device) == (1 if same else 2)
        return True

    wire.until_long_enough(is_in_time, "the part of a reply comes")


def in_vain(client: Face) -> bool:
    """Has a read time out. Whether it had a connection: a loaded machine may make none in time."""
    with pytest.raises(holdfast.RequestTimeout) as caught:
        client.read_holding_registers(7, 1)
    return str(caught.value).startswith("no reply")


def test_a_device_that_reads_nothing_times_out(make: Make, dial: Dial) -> None:
    def is_connected(timeout: float) -> bool:
        device = make("tcp", deaf=True)
        client = dial(device.url, timeout=timeout)
        if not in_vain(client):
            return False
        assert in_vain(client)
        assert connections(device) == 1
        return True

    wire.until_long_enough(is_connected, "there is a connection")


@pytest.mark.parametrize(("timeouts", "made"), [(2, 1), (3, 2), (5, 2)])
def test_a_connection_that_has_gone_silent_is_made_anew(
    make: Make, dial: Dial, timeouts: int, made: int
) -> None:
    def is_made_anew(timeout: float) -> bool:
        device = make("tcp", good, *[silent] * timeouts)
        client = connected(dial, device.url, timeout)
        if not all(in_vain(client) for _ in range(timeouts)):
            return False
        client.timeout = wire.DEADLINE

        assert client.read_holding_registers(8, 1) == [8]
        assert connections(device) == made
        return True

    wire.until_long_enough(is_made_anew, "there is a new connection")


def test_a_late_reply_shows_that_a_connection_is_alive(make: Make, dial: Dial) -> None:
    def is_alive(timeout: float) -> bool:
        sent_at = inf

        def answer_late(_: Asked) -> None:
            nonlocal sent_at
            device.requests[1].answer()
            sent_at = time.monotonic()

        device = make("tcp", good, silent, silent, answer_late, silent)
        client = connected(dial, device.url, timeout)
        for number in range(4):
            began = time.monotonic()
            with pytest.raises(holdfast.RequestTimeout):
                client.read_holding_registers(7, 1)
            if number == 2 and sent_at > began + timeout:
                return False
        client.timeout = wire.DEADLINE

        assert client.read_holding_registers(8, 1) == [8]
        assert connections(device) == 1
        return True

    wire.until_long_enough(is_alive, "the late reply comes before the third timeout")


def test_a_late_reply_is_not_taken_for_the_next_one(make: Make, dial: Dial) -> None:
    device = make("tcp", good, silent)

    def late_then_own(asked: Asked) -> None:
        asked.send(device.requests[1].frame() + asked.frame())

    device.script.append(late_then_own)
    client = connected(dial, device.url, SHORT)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    client.timeout = wire.DEADLINE

    assert client.read_holding_registers(8, 1) == [8]

    assert client.late == 1
    assert connections(device) == 1
    client.close()
    assert client.late == 1
    assert client.read_holding_registers(9, 1) == [9]
    assert (client.late, len(device.requests)) == (1, 4)


def test_a_late_reply_that_is_wrong_does_no_harm(make: Make, dial: Dial) -> None:
    device = make("tcp", good, silent)
    device.script.append(
        lambda asked: asked.send(device.requests[1].frame(b"\x63", unit=9) + asked.frame())
    )
    client = connected(dial, device.url, SHORT)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    client.timeout = wire.DEADLINE

    assert client.read_holding_registers(8, 1) == [8]
    assert (client.late, connections(device)) == (1, 1)


def test_a_late_reply_that_comes_twice_ends_the_connection(make: Make, dial: Dial) -> None:
    device = make("tcp", good, silent)
    device.script.append(lambda asked: asked.send(device.requests[1].frame() * 2 + asked.frame()))
    client = connected(dial, device.url, SHORT)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    client.timeout = wire.DEADLINE

    with pytest.raises(holdfast.InvalidResponse, match=r"transaction id \d+ matches no request"):
        client.read_holding_registers(8, 1)
    assert client.read_holding_registers(9, 1) == [9]
    assert (client.late, connections(device), len(device.requests)) == (1, 2, 4)


@pytest.mark.parametrize("kind", ["rtu+tcp", *LINES])
def test_a_late_reply_is_thrown_away_where_replies_have_no_ids(
    kind: str, make: Make, dial: Dial
) -> None:
    device = make(kind, good, silent)
    client = connected(dial, device.url, SHORT)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    device.await_requests(2)
    device.requests[1].answer()
    client.timeout = wire.DEADLINE

    assert client.read_holding_registers(8, 1) == [8]
    assert len(device.requests) == 3


@pytest.mark.parametrize("kind", LINES)
def test_a_late_reply_is_not_taken_for_that_of_a_call_that_waits(
    kind: str, make: Make, dial: Dial
) -> None:
    def is_told_apart(timeout: float) -> bool:
        device = make(kind, good, silent)
        client = connected(dial, device.url, timeout)
        with pytest.raises(holdfast.RequestTimeout):
            client.read_holding_registers(7, 1)
        if len(device.requests) < 2:
            return False
        with ThreadPoolExecutor(1) as other:
            client.timeout = wire.DEADLINE
            began = time.monotonic()
            call = other.submit(client.read_holding_registers, 8, 1)
            wire.until(lambda: time.monotonic() > began + timeout / 4, "the call waits")
            in_time = time.monotonic() < began + timeout
            device.requests[1].answer()
            value = call.result()
        if not in_time or client.late == 0:
            return False
        assert value == [8]
        return True

    wire.until_long_enough(is_told_apart, "the late reply comes while the next call waits", SHORT)


@pytest.mark.parametrize("kind", ["tcp", *LINES])
def test_a_device_that_is_always_late_gets_more_time(kind: str, make: Make, dial: Dial) -> None:
    """One that does nothing else meanwhile: without more time, no request ever has its reply."""
    timeout = 0.1

    def slow(asked: Asked) -> None:
        threading.Event().wait(1.4 * timeout)
        asked.answer()

    client = connected(dial, make(kind, good, then=slow).url, timeout)

    def has_value() -> bool:
        try:
            assert client.read_holding_registers(7, 1) == [7]
        except (holdfast.RequestTimeout, holdfast.ConnectionLost):
            return False
        return client.late >= 2

    wire.until(has_value, "after two late replies, a request has its reply")
    assert 0 < client.longest_late <= 4 * timeout


# Two replies


def test_a_second_reply_ends_the_connection_and_leaves_the_first_valid(
    make: Make, dial: Dial
) -> None:
    device = make("tcp", lambda asked: asked.send(asked.frame() * 2))
    client = dial(device.url)

    assert client.read_holding_registers(7, 2) == [7, 8]
    assert client.read_holding_registers(8, 2) == [8, 9]
    assert (connections(device), len(device.requests)) == (2, 2)


@pytest.mark.parametrize("junk", [b"\0" * 20, b"\0\0\0\0\0\3\1\3\0", b"\xff\xff\0\0\0\4\1\3\2\0"])
def test_what_comes_unasked_ends_the_connection(junk: bytes, make: Make, dial: Dial) -> None:
    device = make("tcp")
    client = dial(device.url)
    assert client.read_holding_registers(7, 1) == [7]
    device.requests[0].send(junk)

    calls = 0
    while connections(device) == 1:
        calls += 1
        with suppress(holdfast.InvalidResponse):
            assert client.read_holding_registers(8, 1) == [8]
    assert client.read_holding_registers(9, 1) == [9]
    assert len(device.requests) <= calls + 2
    assert connections(device) == 2


@pytest.mark.parametrize("kind", ["rtu+tcp", *LINES])
def test_a_second_reply_is_not_taken_for_the_next_one(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, lambda asked: asked.send(asked.frame() * 2))
    client = dial(device.url)

    assert client.read_holding_registers(7, 1) == [7]
    assert client.read_holding_registers(8, 1) == [8]
    device.requests[1].answer()
    assert client.read_holding_registers(9, 1) == [9]
    assert len(device.requests) == 3


# Lines


def echoing(then: Behaviour = good) -> Behaviour:
    """An adapter that hears what it sends."""

    def behave(asked: Asked) -> None:
        asked.send(asked.raw)
        then(asked)

    return behave


@pytest.mark.parametrize("kind", LINES)
def test_an_echo_is_noticed_by_the_first_read(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, then=echoing())
    client = dial(device.url)

    assert client.read_holding_registers(7, 2) == [7, 8]
    client.write_register(3, 11)
    client.write_registers(4, [12, 13])
    assert client.read_holding_registers(3, 3) == [11, 12, 13]
    assert len(device.requests) == 4


@pytest.mark.parametrize("kind", LINES)
def test_an_echo_may_be_announced(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, then=echoing(), echo=1)
    client = dial(device.url)

    client.write_register(3, 11)
    client.write_registers(4, [12, 13])
    assert client.read_holding_registers(3, 3) == [11, 12, 13]
    assert len(device.requests) == 3


@pytest.mark.parametrize("kind", LINES)
def test_an_echo_alone_is_no_reply(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, echoing(), echoing(silent), echoing(silent), echo=1)
    client = connected(dial, device.url, SHORT)

    with pytest.raises(holdfast.RequestTimeout):
        client.write_register(3, 11)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    device.await_requests(3)


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize(
    "read",
    [
        lambda client: client.read_holding_registers(7, 1) == [7],
        lambda client: client.read_coils(0, 9) == [False] * 9,
        lambda client: client.report_server_id().data == b"\1\xff",
        lambda client: client.event_counter() == (False, 258),
        lambda client: client.identify().vendor_name == "A",
    ],
)
def test_an_echo_may_come_in_pieces(
    kind: str, read: Callable[[Any], bool], make: Make, dial: Dial
) -> None:
    others = {
        11: bytes.fromhex("0b 0000 0102"),
        17: bytes.fromhex("11 02 01 ff"),
        43: bytes.fromhex("2b0e 03 01 00 00 01 00 01 41"),
    }

    def echo_in_pieces(asked: Asked) -> None:
        asked.drip(asked.raw)
        asked.drip(asked.frame(others.get(asked.pdu[0])))

    assert read(dial(make(kind, then=echo_in_pieces).url))


@pytest.mark.parametrize(("kind", "options"), [("rtu", {"silence": 0.1}), ("ascii", {"baud": 300})])
def test_a_call_waits_until_the_line_is_silent(
    kind: str, options: dict[str, Any], make: Make, dial: Dial
) -> None:
    device = make(kind, **options)
    client = dial(device.url)
    assert client.read_holding_registers(7, 1) == [7]
    used = time.monotonic()
    wire.until(lambda: time.monotonic() > used + 0.2, "the line was silent for long")
    device.requests[0].send(b"\x01\x03\x02")

    began = time.monotonic()
    assert client.read_holding_registers(8, 1) == [8]
    # Whoever sent that may have more to say: the silence begins when it is read.
    assert time.monotonic() - began >= 0.1


@pytest.mark.parametrize("kind", LINES)
def test_a_broadcast_waits_for_no_reply(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, silent)
    client = dial(device.url, unit=0)

    client.write_register(3, 11)

    assert client.read_holding_registers(3, 1, unit=1) == [3]
    assert [asked.unit for asked in device.requests] == [0, 1]


@pytest.mark.parametrize("kind", LINES)
def test_a_name_that_is_another_adapter_s_now_is_opened_again_after_a_timeout(
    kind: str, make: Make, dial: Dial, tmp_path: Path
) -> None:
    before, now = make(kind, then=silent), make(kind)
    assert isinstance(before, Serial)
    assert isinstance(now, Serial)
    name = tmp_path / "name"
    name.symlink_to(before.terminal.device)
    client = dial(before.url.replace(str(before.terminal.device), str(name)), timeout=SHORT)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    name.unlink()
    name.symlink_to(now.terminal.device)

    def is_answered() -> bool:
        with suppress(holdfast.RequestTimeout):
            return client.read_holding_registers(7, 1) == [7]
        return False

    wire.until(is_answered, "the other adapter is opened")


def test_on_a_line_that_is_not_silent_nothing_is_sent_and_the_error_says_so(
    make: Make, dial: Dial
) -> None:
    device = make("rtu", silence=10)
    assert isinstance(device, Serial)
    client = dial(device.url, timeout=SHORT)
    os.write(device.terminal.end, b"\xff")
    with pytest.raises(holdfast.RequestTimeout, match=r"nothing was sent within 0\.1 s") as raised:
        client.write_register(0, 1)
    assert not raised.value.maybe_sent
    assert not device.requests


@pytest.mark.parametrize("kind", LINES)
def test_a_line_that_is_gone_is_opened_again(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind)
    assert isinstance(device, Serial)
    client = dial(device.url)
    assert client.read_holding_registers(7, 1) == [7]
    path = device.terminal.device
    moved = path.rename(path.with_name("moved"))
    client.close()

    with pytest.raises(holdfast.ConnectionLost, match=f"can't connect to [a-z]+://{path}"):
        client.read_holding_registers(7, 1)
    moved.rename(path)
    assert client.read_holding_registers(7, 1) == [7]


# UDP


def test_a_read_whose_datagram_was_lost_is_sent_again(make: Make, dial: Dial) -> None:
    def is_sent_again(timeout: float) -> bool:
        device = make("udp", silent, silent)
        # It is sent three times in this time.
        client = dial(device.url, timeout=timeout)
        with suppress(holdfast.RequestTimeout):
            assert client.read_holding_registers(7, 2) == [7, 8]
            assert [asked.raw for asked in device.requests] == [device.requests[0].raw] * 3
            return True
        return False

    wire.until_long_enough(is_sent_again, "the third one is answered")


@pytest.mark.parametrize(
    "write",
    [
        lambda client: client.write_register(7, 1),
        lambda client: client.write_coils(7, [True, False]),
        lambda client: client.mask_write(7, and_mask=1, or_mask=1),
        lambda client: client.read_write(0, 1, 0, [1]),
        lambda client: client.diagnostics(10),
    ],
)
def test_a_write_is_sent_once(write: Callable[[Any], object], make: Make, dial: Dial) -> None:
    device = make("udp", good, silent)
    client = connected(dial, device.url, SHORT)

    with pytest.raises(holdfast.RequestTimeout):
        write(client)
    client.timeout = wire.DEADLINE
    assert client.read_holding_registers(8, 1) == [8]
    assert len(device.requests) == 3


def test_a_read_is_sent_at_most_three_times(make: Make, dial: Dial) -> None:
    def is_sent_three_times(timeout: float) -> bool:
        device = make("udp", then=silent)
        client = dial(device.url, timeout=timeout)
        began = time.monotonic()

        with pytest.raises(holdfast.RequestTimeout):
            client.read_holding_registers(7, 1)

        assert timeout <= time.monotonic() - began < wire.DEADLINE
        device.then = good
        client.timeout = wire.DEADLINE
        assert client.read_holding_registers(8, 1) == [8]
        assert len(device.requests) <= 4
        return len(device.requests) == 4

    wire.until_long_enough(is_sent_three_times, "it is sent three times")


def test_a_device_that_has_gone_silent_is_asked_from_another_socket(make: Make, dial: Dial) -> None:
    device = make("udp", good, then=silent)
    client = connected(dial, device.url, SHORT)
    for _ in range(3):
        with pytest.raises(holdfast.RequestTimeout):
            client.read_holding_registers(7, 1)
    device.then = good
    client.timeout = wire.DEADLINE

    assert client.read_holding_registers(8, 1) == [8]

    first, last = device.requests[0].peer, device.requests[-1].peer
    assert isinstance(first, Sender)
    assert isinstance(last, Sender)
    assert first.address != last.address


def test_datagrams_that_are_late_or_come_twice_are_counted(make: Make, dial: Dial) -> None:
    device = make("udp", lambda asked: asked.send(asked.frame(), asked.frame()), silent)
    device.script.append(lambda asked: asked.send(device.requests[1].frame(), asked.frame()))
    client = dial(device.url, timeout=wire.DEADLINE)

    assert client.read_holding_registers(7, 1) == [7]
    client.timeout = SHORT
    with pytest.raises(holdfast.RequestTimeout):
        client.write_register(8, 8)
    client.timeout = wire.DEADLINE
    assert client.read_holding_registers(9, 1) == [9]

    assert client.late == 2
    assert len(device.requests) == 3


@pytest.mark.parametrize("lie", ["transaction", "unit"])
def test_a_datagram_with_another_id_is_passed_over(lie: str, make: Make, dial: Dial) -> None:
    def other(asked: Asked) -> None:
        header = {lie: getattr(asked, lie) ^ 1}
        asked.send(asked.frame(b"\3\2\0\0", **header), asked.frame())

    device = make("udp", other)
    client = dial(device.url)

    assert client.read_holding_registers(7, 1) == [7]
    assert client.late == 0


@pytest.mark.parametrize(
    "datagram",
    [b"", b"\0", b"\0" * 300, bytes.fromhex("0000000000050103020007ff"), b"\xff" * 65_000],
    ids=["empty", "a byte", "zeros", "a byte too many", "huge"],
)
def test_a_datagram_that_is_no_frame_is_refused(datagram: bytes, make: Make, dial: Dial) -> None:
    invalid_then_good(
        lambda: make("udp", lambda asked: asked.send(datagram)),
        dial,
        "the datagram is not one frame",
    )


@pytest.mark.parametrize("lie", WRONG_PDUS)
def test_a_pdu_that_is_no_reply_is_refused_over_udp(lie: str, make: Make, dial: Dial) -> None:
    pdu, text = WRONG_PDUS[lie]
    invalid_then_good(lambda: make("udp", replies(pdu)), dial, text)


def test_a_port_where_nobody_listens_is_lost(dial: Dial) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
    with pytest.raises(holdfast.ConnectionLost):
        dial(f"udp://127.0.0.1:{port}").read_coils(0, 1)


# Many in flight


def read_all(plc: holdfast.Client, count: int) -> list[asyncio.Task[list[int]]]:
    return [asyncio.create_task(plc.read_holding_registers(at, 1)) for at in range(count)]


def test_requests_that_time_out_together_count_as_one() -> None:
    async def main() -> None:
        with Stream("tcp", good, *[silent] * 32) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=16) as plc:
                assert await plc.read_holding_registers(7, 1) == [7]
                plc.timeout = SHORT
                for _ in range(2):
                    found = await asyncio.gather(*read_all(plc, 16), return_exceptions=True)
                    assert {type(each) for each in found} == {holdfast.RequestTimeout}
                plc.timeout = wire.DEADLINE
                assert await plc.read_holding_registers(8, 1) == [8]
                assert device.connections == 1

    run(main)


def test_replies_may_come_in_any_order() -> None:
    async def main() -> None:
        with Stream("tcp", then=silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=16) as plc:
                tasks = read_all(plc, 16)
                await asyncio.to_thread(device.await_requests, 16)
                device.requests[0].send(
                    b"".join(asked.frame() for asked in reversed(device.requests))
                )
                assert await asyncio.gather(*tasks) == [[at] for at in range(16)]

    run(main)


@pytest.mark.parametrize(
    ("behaviour", "error"),
    [
        (replies("0302 0000", unit=9), holdfast.InvalidResponse),
        (replies("0402 0000"), holdfast.InvalidResponse),
        (replies("0302 0000", transaction=999), holdfast.InvalidResponse),
        (close, holdfast.ConnectionLost),
        (reset, holdfast.ConnectionLost),
    ],
    ids=["unit", "function", "transaction", "close", "reset"],
)
def test_all_calls_in_flight_end_with_their_connection(
    behaviour: Behaviour, error: type[holdfast.ModbusError]
) -> None:
    async def main() -> None:
        with Stream("tcp", silent, silent) as device:
            device.script.append(lambda _: behaviour(device.requests[1]))
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=3) as plc:
                tasks = read_all(plc, 4)
                for task in tasks[:3]:
                    with pytest.raises(error):
                        await task
                # It waited for its turn, and has a new connection.
                assert await tasks[3] == [3]
                assert (device.connections, len(device.requests)) == (2, 4)

    run(main)


def test_a_call_that_times_out_leaves_the_others_alone() -> None:
    async def main() -> None:
        with Stream("tcp", good, silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=2) as plc:
                assert await plc.read_holding_registers(0, 1) == [0]
                plc.timeout = SHORT
                first = asyncio.create_task(plc.read_holding_registers(1, 1))
                await asyncio.to_thread(device.await_requests, 2)
                plc.timeout = wire.DEADLINE
                assert await plc.read_holding_registers(2, 1) == [2]
                with pytest.raises(holdfast.RequestTimeout):
                    await first
                assert await plc.read_holding_registers(3, 1) == [3]
                assert (device.connections, plc.late) == (1, 0)

    run(main)


def test_a_call_with_a_shorter_timeout_ends_first() -> None:
    async def main() -> None:
        with Stream("tcp", then=silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=3) as plc:
                patient = read_all(plc, 2)
                await asyncio.to_thread(device.await_requests, 2)
                for plc.timeout in (SHORT, SHORT / 2):
                    with pytest.raises(holdfast.RequestTimeout, match=f"within {plc.timeout:g} s"):
                        await plc.read_holding_registers(9, 1)
                device.requests[1].answer()
                device.requests[0].answer()
                assert await asyncio.gather(*patient) == [[0], [1]]

    run(main)


def test_a_reply_that_breaks_off_ends_the_connection_of_all() -> None:
    async def breaks_off(timeout: float) -> bool:
        sent_at = inf

        def note(_: Asked) -> None:
            nonlocal sent_at
            sent_at = time.monotonic()

        with Stream("tcp", silent, half(note)) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=2) as plc:
                patient = asyncio.create_task(plc.read_holding_registers(2, 1))
                await asyncio.to_thread(device.await_requests, 1)
                plc.timeout = timeout
                began = time.monotonic()
                with pytest.raises(holdfast.RequestTimeout):
                    await plc.read_holding_registers(1, 1)
                plc.timeout = wire.DEADLINE
                if sent_at > began + timeout:
                    patient.cancel()
                    return False
                with pytest.raises(holdfast.ConnectionLost, match="a reply was cut off"):
                    await patient
                assert await plc.read_holding_registers(3, 1) == [3]
                assert device.connections == 2
                return True

    wire.until_long_enough(lambda timeout: run(partial(breaks_off, timeout)), "half of it comes")


def test_a_lost_connection_is_made_anew_once_for_all_calls() -> None:
    async def main() -> None:
        with Stream("tcp", *[silent] * 7, reset) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE, max_in_flight=8) as plc:
                results = await asyncio.gather(*read_all(plc, 24), return_exceptions=True)
                assert {type(result) for result in results[:8]} == {holdfast.ConnectionLost}
                assert results[8:] == [[at] for at in range(8, 24)]
                assert (device.connections, len(device.requests)) == (2, 24)

    run(main)


def test_calls_that_wait_for_a_connection_are_all_told_that_there_is_none() -> None:
    async def main() -> None:
        with socket.socket() as nobody:
            nobody.bind(("127.0.0.1", 0))
            url = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
            async with holdfast.Client(url, timeout=wire.DEADLINE, max_in_flight=2) as plc:
                results = await asyncio.gather(*read_all(plc, 6), return_exceptions=True)
                assert {type(result) for result in results} == {holdfast.ConnectFailed}
                assert len({id(result) for result in results}) == 6

    run(main)


# Anything at all


def mbap_reply(asked: Asked, count: int, data: bytes) -> list[int] | None:
    """The registers, if the first frame of some bytes answers a read of registers."""
    if len(data) < 9 + 2 * count:
        return None
    expected = struct.pack(">HHHBBB", asked.transaction, 0, 3 + 2 * count, 1, 3, 2 * count)
    if data[:9] != expected:
        return None
    return list(struct.unpack_from(f">{count}H", data, 9))


def rtu_reply(count: int, data: bytes) -> list[int] | None:
    end = 5 + 2 * count
    frame = data[:end]
    if len(frame) < end or frame[:3] != bytes([1, 3, 2 * count]):
        return None
    if lines.crc(frame[:-2]) != frame[-2:]:
        return None
    return list(struct.unpack_from(f">{count}H", frame, 3))


PDUS = st.one_of(
    st.binary(max_size=12),
    st.builds(lambda data: b"\3\4" + data, st.binary(min_size=3, max_size=5)),
    st.builds(lambda data: b"\3\4" + data, st.binary(min_size=4, max_size=4)),
    st.builds(lambda code: bytes([0x83, code]), st.integers(0, 255)),
)
FRAMES = st.one_of(
    st.binary(max_size=20),
    st.tuples(PDUS, st.sampled_from([1, 1, 1, 0, 2, 255]), st.sampled_from([0, 0, 0, 1, -1])),
)
ANYTHING = st.tuples(st.lists(FRAMES, min_size=1, max_size=3), st.booleans())
"""Frames, right, nearly right and not right at all; and whether they come byte by byte."""


@pytest.mark.parametrize("kind", [*STREAMS, "udp"])
@settings(
    max_examples=examples(100),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(ANYTHING)
def test_whatever_comes_is_a_reply_only_if_it_is_one(
    kind: str, make: Make, dial: Dial, anything: tuple[list[Any], bool]
) -> None:
    parts, drip = anything
    sent = b""

    def behave(asked: Asked) -> None:
        nonlocal sent
        for part in parts:
            sent += (
                part
                if isinstance(part, bytes)
                else asked.frame(part[0], unit=part[1], transaction=asked.transaction + part[2])
            )
        (asked.drip if drip and kind != "udp" else asked.send)(sent)
        # Whatever that was, nothing better comes.
        asked.send(b"the datagram is not one frame") if kind == "udp" else close(asked)

    if not hasattr(make, "device"):
        make.device = make(kind)  # type: ignore[attr-defined]
    # A new one, which does not wait for replies to earlier requests.
    device, client = make.device, dial(make.device.url)  # type: ignore[attr-defined]
    first = len(device.requests)
    device.then = behave
    try:
        result = client.read_holding_registers(7, 2)
    except holdfast.ModbusError:
        result = None
    client.close()
    asked = device.requests[first]
    if kind == "rtu+tcp":
        found = [rtu_reply(2, sent[start:]) for start in range(len(sent) + 1)]
        assert result in found
        # What comes before a reply is skipped only if it can't be the reply itself.
        # One that equals the reply to an earlier request is refused if something follows it.
        is_refused = result is None and len(parts) > 1
        assert found[0] in (None, result) or is_refused
        return
    reply = mbap_reply(asked, 2, sent)
    if kind == "udp" and len(sent) != 13:
        reply = None
    assert result == reply


# Signals


LONG = 4 * wire.DEADLINE
"""A timeout that is not waited for."""


def is_calling() -> bool:
    """Whether the main thread is inside the client."""
    frame = sys._current_frames()[threading.main_thread().ident or 0]
    return Path(frame.f_code.co_filename).parts[-3:-1] == ("holdfast", "client")


@contextmanager
def interrupt_when(happens: Callable[[], bool]) -> Iterator[None]:
    """Expects that SIGINT ends a call soon after a condition is true."""

    def interrupt() -> None:
        wire.until(happens, "the device has been asked")
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    began = time.monotonic()
    thread.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            yield
        assert time.monotonic() - began < LONG / 2
    finally:
        thread.join()
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("kind", [*STREAMS, "ascii+tcp", *DATAGRAMS, *LINES])
def test_a_signal_ends_the_wait_for_a_reply(kind: str, make: Make) -> None:
    device = make(kind, silent)
    with holdfast.SyncClient(device.url, timeout=LONG) as client:
        with interrupt_when(lambda: len(device.requests) == 1):
            client.read_holding_registers(7, 2)

        assert client.read_holding_registers(7, 2) == [7, 8]


def test_a_signal_ends_the_wait_for_a_turn(make: Make) -> None:
    device = make("tcp", silent)
    with (
        holdfast.SyncClient(device.url, timeout=LONG) as client,
        ThreadPoolExecutor(1) as executor,
    ):
        first = executor.submit(client.read_holding_registers, 7, 2)
        wire.until(lambda: len(device.requests) == 1, "the first request")
        with interrupt_when(is_calling):
            client.read_holding_registers(0, 1)
        assert len(device.requests) == 1
        device.requests[0].answer()

        assert first.result(wire.DEADLINE) == [7, 8]
        assert client.read_holding_registers(5, 1) == [5]


def test_a_signal_ends_a_handshake(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener, ExitStack() as accepted:
        listener.settimeout(wire.DEADLINE)
        url = f"tls://127.0.0.1:{listener.getsockname()[1]}?ca={Certificates(tmp_path).ca}"

        def hello() -> bool:
            peer = accepted.enter_context(listener.accept()[0])
            return bool(peer.recv(1))

        with holdfast.SyncClient(url, timeout=LONG) as client, interrupt_when(hello):
            client.read_holding_registers(0, 1)


@contextmanager
def handled_when(happens: Callable[[], bool], handle: Callable[[], object]) -> Iterator[None]:
    """Runs a signal handler once a condition is true."""

    def interrupt() -> None:
        wire.until(happens, "the device has been asked")
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)

    thread = threading.Thread(target=interrupt)
    before = signal.signal(signal.SIGUSR1, lambda *_: handle())
    try:
        thread.start()
        yield
    finally:
        thread.join()
        signal.signal(signal.SIGUSR1, before)


def test_a_handler_that_does_not_raise_leaves_the_call_alone(make: Make) -> None:
    device = make("tcp", silent)
    refused: list[str] = []

    def handle() -> None:
        try:
            client.read_holding_registers(0, 1)
        except RuntimeError as error:
            refused.append(str(error))
        device.requests[0].answer()

    with (
        holdfast.SyncClient(device.url, timeout=LONG) as client,
        handled_when(lambda: len(device.requests) == 1, handle),
    ):
        assert client.read_holding_registers(7, 2) == [7, 8]
    [why] = refused
    assert why.startswith("this client is waiting for a reply")


@pytest.mark.parametrize("kind", [*STREAMS, *DATAGRAMS, *LINES])
def test_a_handler_that_closes_the_client_ends_the_call(kind: str, make: Make) -> None:
    device = make(kind, silent)
    with holdfast.SyncClient(device.url, timeout=LONG) as client:
        with (
            handled_when(lambda: len(device.requests) == 1, client.close),
            pytest.raises(holdfast.ConnectionLost) as lost,
        ):
            client.write_register(7, 2)
        assert lost.value.maybe_sent

        assert client.read_holding_registers(5, 1) == [5]


def test_a_handler_that_closes_the_client_can_end_the_program(make: Make) -> None:
    device = make("tcp", silent)
    client = holdfast.SyncClient(device.url, timeout=LONG)

    def handle() -> None:
        client.close()
        sys.exit(7)

    with (
        handled_when(lambda: len(device.requests) == 1, handle),
        pytest.raises(SystemExit, match="7"),
    ):
        client.write_register(7, 2)
