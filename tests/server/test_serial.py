"""Modbus RTU and ASCII on serial lines, as a client at the other end of the line sees it.

The lines are pseudo terminals. Where no reply may come, a counter says that the frame was judged,
and the reply to the next request is the first that comes.
"""

from __future__ import annotations

import fcntl
import itertools
import logging
import re
import struct
import subprocess
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
from pymodbus.client import AsyncModbusSerialClient, ModbusSerialClient
from pymodbus.framer import FramerType

import holdfast
from holdfast.types import AREAS
from support import lines, wire
from support.audits import writes
from support.config_folder import written
from support.fake_device import Stream, good
from support.lines import ASCII, RTU, UNIT, Cable, Line, Mode
from support.machine import tool
from support.pymodbus_peer import OPTIONS, Patient, connected, tour
from support.routed import Held, await_count
from support.running import content
from support.transports import ALL
from support.vectors import cases, overlay

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
WRITE = bytes.fromhex("0600001234")
WRITE_MANY = bytes.fromhex("100000000204 1234 5678")
RESTART = bytes.fromhex("0800010000")
LISTEN_ONLY = bytes.fromhex("0800040000")
CLEAR = bytes.fromhex("08000a0000")


class Plant:
    """An appliance with one serial listener, and the line that leads to it."""

    def __init__(self, line: Line, appliance: Appliance) -> None:
        self.line = line
        self.appliance = appliance

    @property
    def memory(self) -> holdfast.Memory:
        return self.appliance.memories["plant"]

    @property
    def counters(self) -> dict[str, Any]:
        counters: dict[str, Any] = self.appliance.diagnostics.stats()["listeners"]["line"]
        return counters

    def await_frames(self, kind: str, number: int) -> None:
        """Waits until so many frames are counted that no request came of."""
        wire.until(lambda: self.counters["frames"][kind] >= number, f"{number} frames {kind}")
        assert self.counters["frames"][kind] == number

    def await_any_frames(self, number: int) -> None:
        """The same, whatever their kind: on a loaded machine, two may arrive as one."""
        wire.until(lambda: sum(self.counters["frames"].values()) >= number, f"{number} frames")

    def send_until_counted(self, frame: bytes) -> None:
        """Sends a request, again if it has arrived as one with the frame before it."""

        def counted() -> tuple[int, int]:
            counters = self.counters
            return sum(counters["requests"].values()), counters["frames"]["damaged"]

        requests, damaged = counted()
        self.line.send(frame)
        wire.until(lambda: counted() != (requests, damaged), "the request is counted")
        if counted()[0] == requests:
            self.send_until_counted(frame)

    def await_requests(self, number: int) -> None:
        """Waits until so many requests are counted."""
        wire.until(lambda: sum(self.counters["requests"].values()) >= number, "requests")

    def serves(self) -> bool:
        """Whether the next request is answered, and nothing else is."""
        return self.line.ask(READ)[:2] == ZERO[:2] and self.line.is_quiet()


class Start:
    """Starts an appliance on a line of a mode."""

    def __init__(self, line: Line, run: Run) -> None:
        self.line = line
        self._run = run

    def __call__(self, **settings: Any) -> Plant:
        text = lines.configuration(self.line.mode, self.line.device, **settings)
        return Plant(self.line, self._run(text))


@pytest.fixture(params=[RTU, ASCII], ids=lambda mode: mode.name)
def mode(request: pytest.FixtureRequest) -> Mode:
    either: Mode = request.param
    return either


@pytest.fixture
def line(tmp_path: Path, mode: Mode) -> Iterator[Line]:
    with Line(tmp_path / "line", mode) as made:
        yield made


@pytest.fixture
def start(line: Line, run: Run) -> Start:
    return Start(line, run)


@pytest.fixture
def plant(start: Start) -> Plant:
    """Unit 7 is a memory with 1000 items in every area."""
    return start()


only_rtu = pytest.mark.parametrize("mode", [RTU], ids=["rtu"])
only_ascii = pytest.mark.parametrize("mode", [ASCII], ids=["ascii"])


# Vectors


@pytest.mark.parametrize("case", cases("pdu.json"), ids=lambda case: case["name"])
def test_a_pdu_is_answered_and_leaves_memory_as_its_vector_says(
    case: dict[str, Any], start: Start
) -> None:
    size = 1000
    plant = start(memories={"plant": dict.fromkeys(AREAS, size)})
    expected = {area: [0] * size for area in AREAS}
    overlay(expected, case["setup"])
    for area in AREAS:
        plant.memory.write(area, 0, expected[area])

    assert plant.line.ask(bytes.fromhex(case["request"])).hex() == case["response"]
    overlay(expected, case["after"])
    assert {area: plant.memory.read(area, 0, size) for area in AREAS} == expected


REQUESTS = [case for case in cases("frames.json") if int(case["pdu"][:2], 16) < 0x80]


@pytest.mark.parametrize("case", REQUESTS, ids=lambda case: case["pdu"])
def test_a_frame_is_served_as_its_vector_spells_it(case: dict[str, Any], start: Start) -> None:
    plant, unit, pdu = start(units={case["unit"]: "plant"}), case["unit"], case["pdu"]
    text: str = case[plant.line.mode.name]
    frame = bytes.fromhex(text) if plant.line.mode is RTU else text.encode()

    plant.line.send(frame)

    answered, reply = plant.line.receive()
    assert frame == plant.line.mode.frame(bytes.fromhex(pdu), unit)
    assert (answered, reply[0] & 0x7F) == (unit, int(pdu[:2], 16) & 0x7F)


# Frames that are passed over


@pytest.mark.parametrize("unit", [1, 6, 8, 247, 255])
def test_a_frame_for_another_unit_is_passed_over(unit: int, plant: Plant) -> None:
    plant.line.send(plant.line.mode.frame(WRITE, unit))
    plant.await_frames("other_unit", 1)

    assert plant.serves()
    assert plant.counters["requests"] == {3: 1}
    assert not any(content(plant.memory)["holding_registers"])


def test_the_replies_of_other_units_are_passed_over(plant: Plant) -> None:
    for number, pdu in enumerate([ZERO, b"\x83\x02", bytes.fromhex("0600001234")], 1):
        plant.line.send(plant.line.mode.frame(pdu, 9))
        plant.await_frames("other_unit", number)

    assert plant.serves()


@pytest.mark.parametrize("unit", [0, UNIT], ids=["broadcast", "own"])
def test_an_exception_is_passed_over_whatever_its_unit(unit: int, plant: Plant) -> None:
    plant.line.send(plant.line.mode.frame(b"\x83\x02", unit))
    plant.await_frames("other_unit", 1)

    assert plant.serves()
    assert plant.counters["requests"] == {3: 1}


@pytest.mark.parametrize("unit", [0, UNIT, 9], ids=["broadcast", "own", "other"])
def test_a_wrong_check_sum_is_passed_over(unit: int, plant: Plant) -> None:
    plant.line.send(plant.line.mode.damaged(WRITE, unit))
    plant.await_frames("damaged", 1)

    assert plant.serves()
    assert not any(content(plant.memory)["holding_registers"])


@only_rtu
def test_a_frame_cut_anywhere_is_passed_over(plant: Plant) -> None:
    frame = lines.rtu(WRITE_MANY)
    for end in range(1, len(frame)):
        plant.line.send(frame[:end])
        plant.await_frames("damaged", end)

    assert plant.serves()
    assert not any(content(plant.memory)["holding_registers"])


@only_ascii
def test_an_ascii_frame_cut_anywhere_ends_where_the_next_begins(plant: Plant) -> None:
    frame = lines.ascii_frame(WRITE)
    for end in range(1, len(frame)):
        plant.line.send(frame[:end])
        assert plant.line.ask(READ) == ZERO

    plant.await_frames("damaged", len(frame) - 1)
    assert plant.serves()


@only_rtu
@pytest.mark.parametrize("noise", [b"\x00", b"\xff" * 3, bytes(255), bytes(range(256)) * 5])
def test_noise_between_rtu_frames_is_passed_over(noise: bytes, plant: Plant) -> None:
    plant.line.send_pieces(noise)
    wire.until(lambda: plant.counters["frames"]["damaged"] >= 1, "the noise is counted")

    assert plant.serves()


@only_rtu
@pytest.mark.parametrize("unit", [0, UNIT], ids=["broadcast", "own"])
@pytest.mark.parametrize("noise", [b"\x00", b"\x00\x00", b"\xff"])
def test_noise_right_behind_a_request_makes_it_a_damaged_frame(
    noise: bytes, unit: int, plant: Plant
) -> None:
    plant.line.send(lines.rtu(WRITE, unit) + noise)
    plant.await_frames("damaged", 1)

    assert plant.serves()
    assert not any(content(plant.memory)["holding_registers"])


@only_ascii
@pytest.mark.parametrize("noise", [b"\x00", b"\r\n", b"0703", b"\xff" * 3, bytes(range(58)) * 20])
def test_noise_between_ascii_frames_is_passed_over(noise: bytes, plant: Plant) -> None:
    plant.line.send(noise)

    assert plant.serves()
    assert plant.serves()


@only_ascii
@pytest.mark.parametrize(
    "frame",
    [
        b":0703000000G1F5\r\n",
        b":07 0300000001F5\r\n",
        b":0703000000001F5\r\n",
        b":07030000000\x001F5\r\n",
        b":0703000000\xb01F5\r\n",
        b":0703000000\r\n01F5\r\n",
        b":0703\n00000001F5\r\r\n",
        b":\r\n",
        b":07\r\n",
        b":07F9\r\n",
        b":" + b"07" * 256 + b"\r\n",
        b":" + b"0" * 5000,
    ],
    ids=lambda frame: frame[:20].decode("latin1"),
)
def test_an_ascii_frame_of_another_form_is_passed_over(frame: bytes, plant: Plant) -> None:
    plant.line.send(frame)
    plant.await_frames("damaged", 1)

    assert plant.serves()


@only_rtu
def test_a_frame_longer_than_any_is_passed_over(plant: Plant) -> None:
    plant.line.send(lines.rtu(bytes.fromhex("080000") + bytes(251)))
    plant.await_frames("damaged", 1)

    assert plant.serves()


def test_the_longest_frame_is_served(plant: Plant) -> None:
    pdu = bytes.fromhex("080000") + bytes(range(250))

    assert plant.line.ask(pdu) == pdu


def test_a_unit_answers_with_exceptions_as_over_tcp(plant: Plant) -> None:
    for pdu, reply in [
        (b"\x63", b"\xe3\x01"),
        (bytes.fromhex("0303e80001"), b"\x83\x02"),
        (bytes.fromhex("0300000000"), b"\x83\x03"),
        (bytes.fromhex("03"), b"\x83\x03"),
        (bytes.fromhex("0600"), b"\x86\x03"),
    ]:
        assert plant.line.ask(pdu) == reply


# Silence and pauses


@only_rtu
def test_rtu_frames_without_silence_between_them_are_one_damaged_frame(plant: Plant) -> None:
    plant.line.send(lines.rtu(WRITE) + lines.rtu(READ))
    plant.await_frames("damaged", 1)

    assert plant.serves()
    assert plant.memory.read("holding_registers", 0, 1) == [0]


@only_rtu
def test_a_frame_may_arrive_in_pieces_when_the_silence_is_longer_than_the_pauses(
    start: Start,
) -> None:
    plant = start(serial={"silence": 0.5})
    frame = lines.rtu(WRITE_MANY)
    plant.line.send_pieces(*[bytes([byte]) for byte in frame])

    assert plant.line.receive() == (UNIT, WRITE_MANY[:5])
    assert plant.memory.read("holding_registers", 0, 2) == [0x1234, 0x5678]


@only_rtu
def test_a_silence_that_is_configured_holds_in_place_of_that_of_the_baud_rate(
    start: Start,
) -> None:
    # At 50 baud the silence of the standard is 0.77 s: too long for all of these.
    plant = start(serial={"silence": 0.0005, "baud": 50})
    frame, deadline = lines.rtu(WRITE), time.monotonic() + wire.DEADLINE
    for number in range(1, 20):
        plant.line.send(frame[:4] if number % 2 else frame[4:])
        plant.await_frames("damaged", number)

    assert time.monotonic() < deadline
    assert plant.serves()


def test_a_reply_that_comes_back_is_no_request(plant: Plant) -> None:
    """A two-wire adapter may receive what it sends."""
    for pdu, reply in ((WRITE, WRITE), (READ, bytes.fromhex("03021234")), (WRITE, WRITE)):
        plant.line.send(plant.line.mode.frame(pdu))
        assert plant.line.receive() == (UNIT, reply)
        plant.memory.write("holding_registers", 0, [0x1234])
        plant.line.send(plant.line.mode.frame(reply))

    assert plant.line.ask(READ) == bytes.fromhex("03021234")
    assert plant.line.is_quiet()
    assert sum(plant.counters["requests"].values()) == 4
    plant.memory.write("holding_registers", 0, [0])
    assert plant.serves()


def test_a_write_may_be_repeated_at_once(plant: Plant) -> None:
    assert plant.line.ask(READ) == ZERO
    assert [plant.line.ask(WRITE) for _ in range(3)] == [WRITE] * 3


@only_rtu
def test_a_request_that_begins_like_the_reply_before_it_is_no_echo(plant: Plant) -> None:
    """The check sum of some replies is the byte count and the first byte of the next write."""
    places = itertools.product(range(800), range(1, 124))
    confirmed = (struct.pack(">BHH", 16, address, count) for address, count in places)
    reply = next(pdu for pdu in confirmed if lines.rtu(pdu)[-2] == 2 * pdu[-1])
    for number in range(1, 4):
        registers = lines.rtu(reply)[-1:] + bytes(2 * reply[-1] - 2) + bytes([number])
        assert plant.line.ask(reply + bytes([2 * reply[-1]]) + registers) == reply
        address = int.from_bytes(reply[1:3])
        assert plant.memory.read("holding_registers", address, reply[-1])[-1] & 0xFF == number
    assert [plant.line.ask(WRITE) for _ in range(3)] == [WRITE] * 3


def test_a_reply_that_a_master_no_longer_waits_for_is_not_sent(start: Start) -> None:
    """The system hands over what is written to a pseudo-terminal a little later, and on a loaded
    machine perhaps after the reply. Then the master's second request has come too late.
    """
    tries = [Held() for _ in range(5)]
    with Stream("tcp", then=good) as device:
        device.script = [each for held in tries for each in (held, good)]
        plant = start(
            units={UNIT: {"route": "meter"}},
            devices={"meter": {"url": device.url, "unit": 1, "timeout": wire.DEADLINE}},
        )
        for number, held in enumerate(tries):
            plant.line.send(plant.line.mode.frame(bytes.fromhex("0300050001")))
            device.await_requests(2 * number + 1)
            plant.line.send_pieces(plant.line.mode.frame(bytes.fromhex("0300060001")))
            held.release()
            reply = plant.line.receive()
            if reply == (UNIT, bytes.fromhex("03020006")):
                assert plant.line.is_quiet()
                return
            assert reply == (UNIT, bytes.fromhex("03020005"))
            assert plant.line.receive() == (UNIT, bytes.fromhex("03020006"))
    raise AssertionError("replies came that nobody waits for")


def test_a_write_that_a_master_no_longer_waits_for_is_not_sent(start: Start) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        plant = start(
            units={UNIT: {"route": "meter"}, UNIT + 1: "plant"},
            devices={"meter": {"url": device.url, "unit": 1, "timeout": wire.DEADLINE}},
        )
        frame = plant.line.mode.frame
        plant.line.send(frame(READ, UNIT))
        device.await_requests(1)
        plant.line.send(frame(WRITE, UNIT))
        await_count(plant.appliance, "waiting", 2, "meter")
        assert plant.line.ask(READ, UNIT + 1) == ZERO
        held.release()
        await_count(plant.appliance, "withdrawn", 1, "meter")
        await_count(plant.appliance, "waiting", 0, "meter")
        assert plant.line.is_quiet()
    assert [asked.pdu for asked in device.requests] == [READ]


@only_rtu
def test_a_master_that_has_asked_another_unit_no_longer_waits(start: Start) -> None:
    """The reply of the other unit is no request, but comes after one. Repeated as above."""
    tries = [Held() for _ in range(5)]
    with Stream("tcp", then=good) as device:
        device.script = [each for held in tries for each in (held, good)]
        plant = start(
            serial={"silence": 0.0001},
            units={UNIT: {"route": "meter"}},
            devices={"meter": {"url": device.url, "unit": 1, "timeout": wire.DEADLINE}},
        )
        for number, held in enumerate(tries):
            plant.line.send(lines.rtu(bytes.fromhex("0300050001")))
            device.await_requests(2 * number + 1)
            reply = bytes.fromhex("030a 0001 0001 0001 0001 0001")
            plant.line.send_pieces(lines.rtu(READ, 9))
            plant.line.pause(0.02)
            plant.line.send_pieces(lines.rtu(reply, 9))
            held.release()
            plant.await_any_frames(number + 1)
            plant.send_until_counted(lines.rtu(bytes.fromhex("0300060001")))
            answered = plant.line.receive()
            if answered == (UNIT, bytes.fromhex("03020006")):
                assert plant.line.is_quiet()
                return
            assert answered == (UNIT, bytes.fromhex("03020005"))
            assert plant.line.receive() == (UNIT, bytes.fromhex("03020006"))
    raise AssertionError("replies came that nobody waits for")


def test_a_line_that_another_program_has_locked_is_not_opened(line: Line) -> None:
    client = holdfast.SyncClient(f"{line.mode.name}://{line.device}?parity=none", timeout=0.1)
    with line.device.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(holdfast.ConnectFailed, match="another program uses the line"):
            client.read_coils(0, 1)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_coils(0, 1)
    with line.device.open("rb") as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    client.close()


def test_a_line_that_another_client_of_this_program_uses_is_not_opened(line: Line) -> None:
    url = f"{line.mode.name}://{line.device}?parity=none"
    one, two = (holdfast.SyncClient(url, timeout=0.1) for _ in range(2))
    with pytest.raises(holdfast.RequestTimeout):
        one.read_coils(0, 1)
    with pytest.raises(holdfast.ConnectFailed, match="another client or listener of this program"):
        two.read_coils(0, 1)
    one.close()
    with pytest.raises(holdfast.RequestTimeout):
        two.read_coils(0, 1)
    two.close()


@only_ascii
def test_characters_may_come_one_by_one(plant: Plant) -> None:
    plant.line.send_pieces(*[bytes([character]) for character in lines.ascii_frame(READ)])

    assert plant.line.receive() == (UNIT, ZERO)


@only_ascii
def test_more_than_a_second_between_two_characters_ends_the_frame(plant: Plant) -> None:
    half, rest = lines.ascii_frame(WRITE)[:9], lines.ascii_frame(WRITE)[9:]
    plant.line.send(half)
    plant.await_frames("damaged", 1)
    plant.line.send(rest)

    assert plant.serves()
    assert plant.memory.read("holding_registers", 0, 1) == [0]


@only_ascii
def test_a_colon_starts_the_frame_anew(plant: Plant) -> None:
    plant.line.send(b":::07060000" + lines.ascii_frame(WRITE))

    assert plant.line.receive() == (UNIT, WRITE)
    assert plant.counters["frames"]["damaged"] == 3


@only_ascii
@pytest.mark.parametrize("change", [bytes.lower, bytes.swapcase], ids=["all", "mixed"])
def test_digits_may_be_small_letters(change: Any, plant: Plant) -> None:
    request = bytes.fromhex("0600abcdef")
    framed = lines.ascii_frame(request)
    framed = framed[:10] + change(framed[10:]) if change is bytes.swapcase else change(framed)
    plant.line.send(framed)

    assert plant.line.receive() == (UNIT, request)


@only_ascii
def test_ascii_requests_may_follow_one_another_at_once(plant: Plant) -> None:
    plant.memory.write("holding_registers", 0, range(50))
    asked = [struct.pack(">BHH", 3, address, 1) for address in range(50)]
    plant.line.send(b"".join(map(lines.ascii_frame, asked)))

    replies = [plant.line.receive() for _ in asked]
    assert replies == [(UNIT, struct.pack(">BBH", 3, 2, value)) for value in range(50)]


# The delimiter of ASCII frames


@only_ascii
@pytest.mark.parametrize("delimiter", b"\x00\n\r#0A:\x7f")
def test_the_delimiter_of_later_requests_can_be_changed(delimiter: int, plant: Plant) -> None:
    change = bytes([8, 0, 3, delimiter, 0])
    assert plant.line.ask(change) == change

    for _ in range(2):
        plant.line.send(lines.ascii_frame(READ)[:-1] + bytes([delimiter]))
        assert plant.line.receive() == (UNIT, ZERO)
    assert plant.counters["frames"]["damaged"] == 0


@only_ascii
def test_a_changed_delimiter_takes_the_place_of_the_line_feed(plant: Plant) -> None:
    assert plant.line.ask(bytes.fromhex("0800032300"))[0] == 8
    plant.line.send(lines.ascii_frame(WRITE) + lines.ascii_frame(READ)[:-1] + b"#")

    assert plant.line.receive() == (UNIT, ZERO)
    assert plant.memory.read("holding_registers", 0, 1) == [0]


# Broadcasts


def test_every_memory_takes_a_broadcast_once_and_nobody_replies(start: Start) -> None:
    plant = start(units={7: "plant", 8: "other", 9: "plant"}, memories={"plant": ALL, "other": ALL})
    plant.line.send(plant.line.mode.frame(WRITE_MANY, 0))
    plant.await_requests(1)

    assert plant.serves()
    for memory in plant.appliance.memories.values():
        assert memory.read("holding_registers", 0, 3) == [0x1234, 0x5678, 0]
    assert plant.counters["requests"] == {16: 1, 3: 1}


@pytest.mark.parametrize(
    ("text", "area", "value"),
    [
        ("050009ff00", "coils", 1),
        ("06000904d2", "holding_registers", 1234),
        ("0f000900010101", "coils", 1),
        ("10000900010204d2", "holding_registers", 1234),
        ("160009000004d2", "holding_registers", 1234),
    ],
    ids=["05", "06", "15", "16", "22"],
)
def test_a_broadcast_may_be_any_write(text: str, area: Any, value: int, plant: Plant) -> None:
    plant.line.send(plant.line.mode.frame(bytes.fromhex(text), 0))
    plant.await_requests(1)

    assert plant.serves()
    assert plant.memory.read(area, 9, 1) == [value]


@pytest.mark.parametrize(
    "text",
    [
        "0100000001",
        "0300000001",
        "080000a537",
        "0800040000",
        "08000a0000",
        "0b",
        "11",
        "2b0e0100",
        "63",
        "83",
        "17000000010000000102ffff",
    ],
)
def test_a_broadcast_that_is_no_write_is_passed_over(text: str, plant: Plant) -> None:
    plant.line.send(plant.line.mode.frame(bytes.fromhex(text), 0))
    plant.await_frames("other_unit", 1)

    assert plant.serves()
    assert not any(content(plant.memory)["holding_registers"])


@pytest.mark.parametrize("text", ["0603e81234", "0500000001", "06", "0603"])
def test_a_broadcast_that_is_refused_has_no_reply_either(text: str, plant: Plant) -> None:
    plant.line.send(plant.line.mode.frame(bytes.fromhex(text), 0))
    plant.await_requests(1)

    assert plant.serves()
    assert sum(plant.counters["exceptions"].values()) == 1


def test_a_broadcast_to_read_only_units_changes_nothing(start: Start) -> None:
    plant = start(rule={"access": "read-only"})
    plant.line.send(plant.line.mode.frame(WRITE, 0))
    plant.await_requests(1)

    assert plant.line.ask(WRITE) == b"\x86\x01"
    assert plant.memory.read("holding_registers", 0, 1) == [0]


def test_a_broadcast_into_what_is_passed_on_to_a_device_is_refused_and_logged(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    into = {"memory": "plant", "area": "holding_registers", "address": 0}
    read = {"area": "holding_registers", "address": 0, "count": 1, "into": into}
    with Stream("tcp") as device:
        meter = {"url": device.url, "interval": 3600, "writes": "pass", "reads": [read]}
        plant = start(devices={"meter": meter})
        plant.line.send(plant.line.mode.frame(WRITE, 0))
        wire.until(lambda: logged(plant, caplog, "refused_address"), "the refusal is logged")

        assert plant.line.ask(WRITE) == WRITE, "a write to its unit is passed on"
    assert [asked.pdu for asked in device.requests if asked.pdu[0] == 6] == [WRITE]


# Diagnostics


def count(line: Line, sub_function: int, unit: int = UNIT) -> int:
    """A counter of function 8."""
    reply = line.ask(struct.pack(">BHH", 8, sub_function, 0), unit)
    code, echoed, counted = struct.unpack(">BHH", reply)
    assert (code, echoed) == (8, sub_function)
    return int(counted)


def events(line: Line) -> int:
    """The event count of function 11."""
    code, status, counted = struct.unpack(">BHH", line.ask(b"\x0b"))
    assert (code, status) == (11, 0)
    return int(counted)


@pytest.fixture
def busy_plant(start: Start) -> Plant:
    """After a clear: 3 reads, 2 exceptions, 2 frames for others, 4 damaged and 1 broadcast."""
    memories = {"plant": ALL, "other": ALL}
    plant = start(units={7: "plant", 8: "other"}, memories=memories)
    line = plant.line
    line.ask(READ)
    line.ask(b"\x63")
    line.send(line.mode.damaged(READ))
    plant.await_frames("damaged", 1)
    assert line.ask(CLEAR) == CLEAR
    for unit in (7, 8, 7):
        assert line.ask(READ, unit) == ZERO
    for refused in ("0303e80001", "0600"):
        assert line.ask(bytes.fromhex(refused))[0] & 0x80
    for number in (1, 2):
        line.send(line.mode.frame(READ, 9))
        plant.await_frames("other_unit", number)
    for number, unit in enumerate((7, 7, 9, 0), 2):
        line.send(line.mode.damaged(READ, unit))
        plant.await_frames("damaged", number)
    line.send(line.mode.frame(WRITE, 0))
    plant.await_requests(9)
    return plant


@pytest.mark.parametrize(
    ("sub_function", "expected"),
    [
        # Messages on the bus, without damaged ones: 5 own, 2 of others, the broadcast, and this.
        (0x0B, 9),
        # Check sums that are wrong, whoever the frame is for.
        (0x0C, 4),
        (0x0D, 2),
        # Messages for the units of this listener: 5, the broadcast, and this.
        (0x0E, 7),
        # Messages without a reply: the broadcast.
        (0x0F, 1),
        (0x10, 0),
        (0x11, 0),
        (0x12, 0),
    ],
    ids=["bus", "errors", "exceptions", "server", "no response", "NAK", "busy", "overrun"],
)
def test_the_counters_of_a_line_are_those_of_the_standard(
    sub_function: int, expected: int, busy_plant: Plant
) -> None:
    assert count(busy_plant.line, sub_function) == expected


def test_the_event_counter_counts_what_was_carried_out(busy_plant: Plant) -> None:
    # 3 reads and the broadcast, the clear itself not among them.
    assert events(busy_plant.line) == 4
    assert events(busy_plant.line) == 4


def test_busy_replies_are_counted(start: Start) -> None:
    seal = {"area": "coils", "address": 0}
    plant = start(memories={"plant": {**ALL, "seal": seal}})
    for _ in range(3):
        assert plant.line.ask(READ) == b"\x83\x06"
    plant.line.send(plant.line.mode.frame(WRITE, 0))
    plant.await_requests(4)
    plant.memory.write("coils", 0, [1])

    assert count(plant.line, 0x11) == 4


def test_a_seal_that_is_opened_by_a_write_from_here_is_open_on_the_line(start: Start) -> None:
    plant = start(memories={"plant": {**ALL, "seal": {"area": "coils", "address": 0}}})
    assert plant.line.ask(READ) == b"\x83\x06"
    assert plant.line.ask(WRITE) == b"\x86\x06"
    plant.line.send(plant.line.mode.frame(WRITE, 0))
    plant.await_requests(3)
    plant.memory.write_many([("coils", 0, [1]), ("holding_registers", 0, [7])])

    assert plant.line.ask(READ) == bytes.fromhex("03020007")
    assert plant.line.ask(WRITE) == WRITE
    assert plant.memory.read("holding_registers", 0, 1) == [0x1234]


# Listen only mode


@pytest.mark.parametrize(
    "text",
    [
        "0300000001",
        "0600001234",
        "08000a0000",
        "0800040000",
        "0b",
        "11",
        "2b0e0100",
        "0300000000",
        "63",
        "0800050000",
        "2b0d0100",
    ],
)
def test_a_unit_in_listen_only_mode_keeps_silent_whatever_is_asked(text: str, start: Start) -> None:
    plant = start(units={7: "plant", 8: "plant"})
    plant.line.send(plant.line.mode.frame(LISTEN_ONLY))
    plant.await_requests(1)
    plant.line.send(plant.line.mode.frame(bytes.fromhex(text)))
    plant.await_requests(2)

    assert plant.line.ask(READ, 8) == ZERO
    assert plant.counters["unanswered"] == 2


def test_a_restart_ends_listen_only_mode_without_a_reply(
    plant: Plant, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    for number, pdu in enumerate((LISTEN_ONLY, WRITE, RESTART), 1):
        plant.line.send(plant.line.mode.frame(pdu))
        plant.await_requests(number)
    for event in ("unit_silenced", "unit_back"):
        wire.until(lambda: logged(plant, caplog, event), f"{event} is logged")  # noqa: B023

    assert plant.serves()
    assert plant.line.ask(RESTART) == RESTART


def test_a_unit_in_listen_only_mode_takes_no_broadcast(start: Start) -> None:
    memories = {"plant": ALL, "other": ALL}
    plant = start(units={7: "plant", 8: "other"}, memories=memories)
    for number, (pdu, unit) in enumerate([(LISTEN_ONLY, 7), (WRITE, 0)], 1):
        plant.line.send(plant.line.mode.frame(pdu, unit))
        plant.await_requests(number)

    assert plant.line.ask(READ, 8) == bytes.fromhex("03021234")
    assert plant.memory.read("holding_registers", 0, 1) == [0]


def test_a_memory_takes_a_broadcast_by_the_unit_that_is_not_silent(start: Start) -> None:
    plant = start(units={7: "plant", 8: "plant"})
    for number, (pdu, unit) in enumerate([(LISTEN_ONLY, 7), (WRITE, 0)], 1):
        plant.line.send(plant.line.mode.frame(pdu, unit))
        plant.await_requests(number)

    assert plant.line.ask(READ, 8) == bytes.fromhex("03021234")


# Identification and rules


def test_the_identification_is_that_of_the_configuration(start: Start) -> None:
    identity = {"vendor_name": "Acme", "product_code": "P1", "revision": "1.2"}
    plant = start(
        units={7: "plant", 8: "plant"}, identity={**identity, "unit_names": {8: "boiler"}}
    )

    def objects(unit: int, code: int) -> bytes:
        return plant.line.ask(bytes([43, 14, code, 0]), unit)[7:]

    assert plant.line.ask(b"\x11")[2:] == b"\x07\xffAcme P1 1.2"
    assert plant.line.ask(b"\x11", 8)[2:] == b"\x08\xffboiler"
    basic = b"\x00\x04Acme\x01\x02P1\x02\x031.2"
    assert objects(7, 1) == objects(7, 2) == basic
    assert objects(8, 2) == basic + b"\x06\x06boiler"
    assert plant.line.ask(bytes.fromhex("2b0e0401"))[7:] == b"\x01\x02P1"
    assert plant.line.ask(bytes.fromhex("2b0e0406")) == b"\xab\x02"


def test_the_rule_holds_on_a_line_too(start: Start) -> None:
    plant = start(rule={"access": "read-only", "deny": [4, 17]})

    assert plant.line.ask(READ) == ZERO
    assert plant.line.ask(WRITE) == b"\x86\x01"
    assert plant.line.ask(bytes.fromhex("0400000001")) == b"\x84\x01"
    assert plant.line.ask(b"\x11") == b"\x91\x01"
    assert plant.line.ask(CLEAR) == b"\x88\x01"


def test_each_unit_of_a_line_has_its_own_rights(start: Start) -> None:
    units = {1: "plant", 2: {"memory": "plant", "functions": [3]}}
    more = {"units": {2: "plant", 3: "plant"}, "access": "read-only"}
    plant = start(units=units, more_rules=[more])

    replies = {unit: plant.line.ask(WRITE, unit) for unit in (1, 2, 3)}
    assert replies == {1: WRITE, 2: b"\x86\x01", 3: b"\x86\x01"}
    assert plant.line.ask(b"\x11", 2) == b"\x91\x01"
    assert plant.line.ask(b"\x11", 3)[:1] == b"\x11"


def test_each_unit_of_a_line_has_its_own_memory(start: Start) -> None:
    plant = start(units={1: "plant", 247: "other"}, memories={"plant": ALL, "other": ALL})
    assert plant.line.ask(WRITE, 247) == WRITE

    assert plant.line.ask(READ, 1) == ZERO
    assert plant.line.ask(READ, 247) == bytes.fromhex("03021234")


def test_the_audit_log_names_the_memories_of_a_broadcast(start: Start, tmp_path: Path) -> None:
    read_only = {"memory": "locked", "access": "read-only"}
    plant = start(
        units={1: "plant", 2: "other", 3: read_only},
        memories=dict.fromkeys(("plant", "other", "locked"), ALL),
        audit={"file": "audit.log"},
    )
    plant.line.send(plant.line.mode.frame(WRITE, 0))
    plant.await_requests(1)
    plant.appliance.stop()

    found = writes(tmp_path / "audit.log")
    assert {(line["unit"], line["memory"], line["outcome"]) for line in found} == {
        (0, "plant", "done"),
        (0, "other", "done"),
        (0, "locked", "illegal_function"),
    }
    assert len(found) == 3


def test_the_writes_of_a_line_are_audited(start: Start, tmp_path: Path) -> None:
    plant = start(audit={"file": "audit.log"})
    plant.line.send(plant.line.mode.frame(WRITE, 0))
    plant.await_requests(1)
    plant.line.send(plant.line.mode.frame(WRITE, 9))
    plant.await_frames("other_unit", 1)
    for pdu in (READ, WRITE, bytes.fromhex("0603e80001")):
        plant.line.ask(pdu)
    plant.appliance.stop()

    found = writes(tmp_path / "audit.log")
    assert {(line["listener"], line["peer"], line["function"]) for line in found} == {
        ("line", None, 6)
    }
    assert [(line["unit"], line["address"], line["outcome"]) for line in found] == [
        (0, 0, "done"),
        (UNIT, 0, "done"),
        (UNIT, 1000, "illegal_data_address"),
    ]


# The life of a line


@pytest.mark.parametrize("parity", ["none", "even", "odd"])
@pytest.mark.parametrize("stop_bits", [1, 2])
def test_a_pseudo_terminal_carries_bytes_whatever_the_form_of_a_character(
    parity: str, stop_bits: int, start: Start
) -> None:
    plant = start(serial={"parity": parity, "stop_bits": stop_bits, "baud": 9600})

    assert plant.serves()


def test_the_lines_of_an_appliance_serve_side_by_side(tmp_path: Path, run: Run) -> None:
    kinds = {"one": RTU, "two": ASCII, "three": RTU}
    listeners = {
        name: {
            "type": mode.listener,
            "serial": {"device": str(tmp_path / name), "parity": "none"},
            "rules": [{"units": {UNIT: "plant"}, "access": "read-write"}],
        }
        for name, mode in kinds.items()
    }
    with ExitStack() as made:
        served = [made.enter_context(Line(tmp_path / name, kinds[name])) for name in kinds]
        appliance = run(written({"memories": {"plant": ALL}, "listeners": listeners}))
        for number in range(20):
            pdu = struct.pack(">BHH", 6, 0, number)
            assert served[number % 3].ask(pdu) == pdu
            for line in served:
                line.send(line.mode.frame(READ))
            reply = struct.pack(">BBH", 3, 2, number)
            assert [line.receive() for line in served] == [(UNIT, reply)] * 3
        appliance.stop()


def test_a_device_that_is_not_there_is_an_os_error_that_names_it(
    mode: Mode, tmp_path: Path, run: Run
) -> None:
    with pytest.raises(OSError, match=r"listener line.*/nowhere") as caught:
        run(lines.configuration(mode, tmp_path / "nowhere"))
    assert isinstance(caught.value, FileNotFoundError)


def test_a_file_is_no_serial_device(mode: Mode, tmp_path: Path, run: Run) -> None:
    with pytest.raises(OSError, match=r"listener line.*appliance\.yaml"):
        run(lines.configuration(mode, tmp_path / "appliance.yaml"))


def logged(plant: Plant, caplog: pytest.LogCaptureFixture, event: str) -> bool:
    """Whether an event is in the log by now."""
    plant.appliance.log_events(0.05)
    return any(
        (record.message, record.fields["listener"]) == (event, "line")
        for record in caplog.records
        if record.name == "holdfast" and hasattr(record, "fields")
    )


def test_a_device_that_is_lost_is_served_again_when_it_is_back(
    plant: Plant, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    assert plant.line.ask(WRITE) == WRITE
    plant.line.send(plant.line.mode.frame(WRITE)[:5])
    plant.line.unplug()
    wire.until(lambda: logged(plant, caplog, "line_lost"), "the loss is logged")
    assert not logged(plant, caplog, "line_back")
    plant.line.plug()
    wire.until(lambda: logged(plant, caplog, "line_back"), "the return is logged")

    assert plant.line.ask(READ) == bytes.fromhex("03021234")
    assert plant.line.is_quiet()


def test_a_stop_does_not_wait_for_half_a_request(plant: Plant) -> None:
    plant.line.send_pieces(plant.line.mode.frame(WRITE)[:5])

    plant.appliance.stop()

    assert plant.line.is_quiet()


def test_a_stop_does_not_wait_for_a_device_that_is_lost(plant: Plant) -> None:
    plant.line.unplug()

    plant.appliance.stop()


@only_ascii
def test_a_line_that_is_full_holds_up_neither_the_stop_nor_others(plant: Plant) -> None:
    longest = lines.ascii_frame(bytes.fromhex("030000007d"))
    assert plant.line.send_until_full(longest * 10_000, 0.2)
    answered = plant.counters["requests"][3]
    assert 1 <= answered < 10_000

    plant.appliance.stop()


def test_a_line_can_be_served_again_after_a_stop(plant: Plant) -> None:
    assert plant.line.ask(WRITE) == WRITE
    for _ in range(3):
        plant.appliance.stop()
        plant.appliance.start()
        assert plant.line.ask(READ) == bytes.fromhex("03021234")


# Real clients


@pytest.fixture
def cable(tmp_path: Path) -> Iterator[Cable]:
    folder = tmp_path / "cable"
    folder.mkdir()
    with Cable(folder) as joined:
        yield joined


@pytest.fixture
def far(cable: Cable, mode: Mode, run: Run) -> tuple[str, holdfast.Memory]:
    """The device at the far end of the cable to an appliance, and the memory of its unit 7."""
    device, client = cable.devices
    identity = {"vendor_name": "Acme"}
    appliance = run(lines.configuration(mode, device, identity=identity))
    return str(client), appliance.memories["plant"]


def mbpoll(kind: str, reference: int, *more: str) -> str:
    line = ["-m", "rtu", "-a", str(UNIT), "-b", "19200", "-P", "none", "-0", "-q"]
    ran = subprocess.run(
        [tool("mbpoll"), *line, "-t", kind, "-r", str(reference), *more],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    return ran.stdout + ran.stderr


@only_rtu
def test_mbpoll_reads_and_writes(far: tuple[str, holdfast.Memory]) -> None:
    device, memory = far
    memory.write("holding_registers", 0, [1, 256, 65535])
    memory.write("coils", 0, [1, 0, 1])

    registers = mbpoll("4", 0, "-c", "3", "-1", device)
    bits = mbpoll("0", 0, "-c", "3", "-1", device)
    written = mbpoll("4", 10, device, "--", "4711", "815")
    missing = mbpoll("4", 1000, "-c", "1", "-1", device)

    values = re.compile(r"^\[(\d+)\]:\s+(\d+)", re.MULTILINE)
    assert values.findall(registers) == [("0", "1"), ("1", "256"), ("2", "65535")]
    assert values.findall(bits) == [("0", "1"), ("1", "0"), ("2", "1")]
    assert "Written 2 references" in written, written
    assert memory.read("holding_registers", 9, 4) == [0, 4711, 815, 0]
    assert "Illegal data address" in missing, missing


FRAMERS = {"rtu": FramerType.RTU, "ascii": FramerType.ASCII}


def test_pymodbus_reads_and_writes(far: tuple[str, holdfast.Memory], mode: Mode) -> None:
    device, memory = far

    with connected(ModbusSerialClient(device, framer=FRAMERS[mode.name], **OPTIONS)) as client:
        tour(client, memory, UNIT)


def test_pymodbus_reads_the_exception_status_and_the_event_log(
    cable: Cable, mode: Mode, run: Run
) -> None:
    device, far_end = cable.devices
    unit = {"memory": "plant", "exception_status": {"area": "discrete_inputs", "address": 7}}
    logs = {"event_log": True}
    appliance = run(lines.configuration(mode, device, units={UNIT: unit}, listener=logs))
    appliance.memories["plant"].write("discrete_inputs", 7, [0, 1, 1, 0, 0, 0, 0, 1])
    made = ModbusSerialClient(str(far_end), framer=FRAMERS[mode.name], **OPTIONS)
    with connected(made) as client:
        assert client.read_exception_status(device_id=UNIT).status == 0b1000_0110
        log = client.diag_get_comm_event_log(device_id=UNIT)

    assert (log.event_count, log.message_count, log.events) == (1, 2, [0x80, 0x40, 0x80])


def test_pymodbus_reads_and_writes_with_asyncio(
    far: tuple[str, holdfast.Memory], mode: Mode
) -> None:
    device, memory = far

    def made() -> AsyncModbusSerialClient:
        return AsyncModbusSerialClient(device, framer=FRAMERS[mode.name], **OPTIONS)

    with Patient(made) as client:
        tour(client, memory, UNIT)
