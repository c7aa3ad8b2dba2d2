"""Functions that only devices have: exception status, event log, files, queues, and their own."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.client.requests import EventLog
from support import lines, vectors
from support.faces import FACES, Dial, dialling
from support.fake_device import (
    HANG_UP,
    LINES,
    Asked,
    FakeDevice,
    ScriptedDevice,
    Serial,
    Stream,
    Udp,
    exception,
    good,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from support.faces import Face

KINDS = ("tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp", "rtu", "ascii")

EXAMPLES = {case["name"]: case for case in vectors.cases("device_pdu.json")}
CALLS: dict[str, tuple[Callable[[Face], object], object]] = {
    "FC07": (lambda client: client.read_exception_status(), 0x6D),
    "FC12": (lambda client: client.event_log(), EventLog(False, 264, 289, b"\x20\x00")),
    "FC20": (
        lambda client: client.read_file_records([(4, 1, 2), (3, 9, 2)]),
        [[0x0DFE, 0x0020], [0x33CD, 0x0040]],
    ),
    "FC21": (lambda client: client.write_file_record(4, 7, [0x06AF, 0x04BE, 0x100D]), None),
    "FC24": (lambda client: client.read_fifo_queue(0x04DE), [0x01B8, 0x1284]),
}


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


@pytest.fixture(params=KINDS)
def device(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ScriptedDevice]:
    """A device that answers as the test says, by the PDU of the request."""
    kind: str = request.param
    made: ScriptedDevice
    if kind in LINES:
        mode = lines.RTU if kind == "rtu" else lines.ASCII
        made = Serial(mode, tmp_path / "line")
    elif kind.endswith("udp"):
        made = Udp(kind=kind)
    else:
        made = Stream(kind)
    with ExitStack() as stack:
        yield stack.enter_context(made)


def answering(*pdus: str) -> Callable[[Asked], None]:
    """Answers each request with the next PDU, then the last one again."""
    left = list(pdus)

    def behave(asked: Asked) -> None:
        asked.answer(bytes.fromhex(left.pop(0) if len(left) > 1 else left[0]))

    return behave


def test_there_is_a_call_for_each_example_of_the_standard() -> None:
    assert CALLS.keys() == EXAMPLES.keys()


@pytest.mark.parametrize("name", CALLS)
def test_a_device_is_asked_as_in_the_standard(
    name: str, device: ScriptedDevice, dial: Dial
) -> None:
    example, (call, result) = EXAMPLES[name], CALLS[name]
    device.then = answering(example["response"])
    client = dial(device.url)

    assert [call(client), call(client)] == [result, result]
    assert [asked.pdu.hex() for asked in device.requests] == [example["request"]] * 2


@pytest.mark.parametrize("name", CALLS)
def test_a_device_may_refuse(name: str, device: ScriptedDevice, dial: Dial) -> None:
    device.then = lambda asked: asked.answer(exception(asked.pdu, 8))

    with pytest.raises(holdfast.ModbusException) as caught:
        CALLS[name][0](dial(device.url))
    assert (caught.value.code, caught.value.name) == (8, "Memory Parity Error")


WRONG = {
    "two bytes of status": ("FC07", "076d00", "length"),
    "a log that is cut": ("FC12", "0c080000010801212000"[:-2], "length"),
    "a log without counts": ("FC12", "0c020000", "length"),
    "65 events": ("FC12", "0c47000001080121" + 65 * "20", "length"),
    "a record too few": ("FC20", "140a05060dfe0020030633cd", "length"),
    "a record too many": ("FC20", "140e05060dfe0020070633cd00401234", "length"),
    "a range too few": ("FC20", "140605060dfe0020", "length"),
    "ranges of other lengths": ("FC20", "140c03060dfe07060020" + "33cd0040", "length"),
    "another reference type": ("FC20", "140c05060dfe0020050733cd0040", "length"),
    "another record written": ("FC21", "150d0600040007000306af04be100e", "echo"),
    "another file written": ("FC21", "150d0600030007000306af04be100d", "echo"),
    "a part of what was written": ("FC21", "15090600040007000106af", "length"),
    "32 registers": ("FC24", "1800420020" + 32 * "0007", "length"),
    "a count that is no half of the bytes": ("FC24", "180006000301b81284", "length"),
    "a cut queue": ("FC24", "180006000201b8", "length"),
}


@pytest.mark.parametrize("device", ["tcp", "udp", "ascii+tcp"], indirect=True)
@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_reply_is_no_value(wrong: str, device: ScriptedDevice, dial: Dial) -> None:
    name, pdu, reason = WRONG[wrong]
    call, result = CALLS[name]
    device.then = answering(pdu, EXAMPLES[name]["response"])
    client = dial(device.url)

    with pytest.raises(holdfast.InvalidResponse) as caught:
        call(client)
    assert caught.value.reason == reason
    assert call(client) == result
    assert len(device.requests) == 2


@pytest.mark.parametrize("device", ["tcp", "rtu+tcp", "rtu"], indirect=True)
def test_an_empty_queue_and_a_full_one_are_read(device: ScriptedDevice, dial: Dial) -> None:
    device.then = answering("1800020000", "180040001f" + 31 * "1234")
    client = dial(device.url)

    assert client.read_fifo_queue(0) == []
    assert client.read_fifo_queue(0) == 31 * [0x1234]


def file_4(asked: Asked) -> None:
    """Answers with records that have their own numbers."""
    record, count = int.from_bytes(asked.pdu[5:7]), int.from_bytes(asked.pdu[7:9])
    records = b"".join(each.to_bytes(2) for each in range(record, record + count))
    asked.answer(bytes([20, len(records) + 2, len(records) + 1, 6]) + records)


@pytest.mark.parametrize("device", ["tcp", "rtu+tcp", "rtu", "ascii"], indirect=True)
def test_many_records_take_several_requests(device: ScriptedDevice, dial: Dial) -> None:
    device.then = file_4

    assert dial(device.url).read_file_record(4, 9700, 300) == list(range(9700, 10_000))
    asked = [request.pdu.hex() for request in device.requests]
    assert asked == ["1407060004" + part for part in ("25e40079", "265d0079", "26d6003a")]


@pytest.mark.parametrize("device", ["tcp", "rtu+tcp", "rtu", "ascii"], indirect=True)
def test_the_most_of_one_request_is_written(device: ScriptedDevice, dial: Dial) -> None:
    device.then = lambda asked: asked.answer(asked.pdu)

    dial(device.url).write_file_record(4, 0, range(122))
    [request] = device.requests
    words = b"".join(each.to_bytes(2) for each in range(122))
    assert request.pdu == bytes.fromhex("15fb0600040000007a") + words


def test_several_files_are_written_in_one_request(dial: Dial) -> None:
    with FakeDevice(lambda pdu: pdu) as device:
        dial(device.url).write_file_records([(4, 7, [1]), (5, 0, [2, 3])])
        [pdu] = device.asked
    assert pdu.hex(" ", 2) == "1514 0600 0400 0700 0100 0106 0005 0000 0002 0002 0003"


def test_a_read_is_sent_again_when_a_used_connection_ends_and_a_write_is_not(dial: Dial) -> None:
    answers: dict[int, list[bytes]] = {}

    def once_lost(pdu: bytes) -> bytes | None:
        """Closes the connection instead of the first reply to each function."""
        first = answers.setdefault(pdu[0], [HANG_UP])
        if first:
            return first.pop()
        return bytes.fromhex(EXAMPLES[f"FC{pdu[0]:02}"]["response"])

    with FakeDevice(once_lost) as device:
        client = dial(device.url)
        with pytest.raises(holdfast.ConnectionLost):
            client.read_exception_status()  # The connection was new.
        assert client.read_exception_status() == 0x6D
        for name in ("FC12", "FC20", "FC24"):
            call, result = CALLS[name]
            assert call(client) == result
        with pytest.raises(holdfast.ConnectionLost) as caught:
            CALLS["FC21"][0](client)
        assert caught.value.maybe_sent
    assert [pdu[0] for pdu in device.asked] == [7, 7, 12, 12, 20, 20, 24, 24, 21]


# Functions of the device's own


def test_a_function_of_the_devices_own_is_called(device: ScriptedDevice, dial: Dial) -> None:
    device.is_modelled = False
    device.then = answering("410a0b0c0d", "41", "c104", "420102")
    client = dial(device.url)

    # The device finds the end of a request by its length on a line.
    assert client.call_function(65, b"\x01\x02\x03\x04") == b"\x0a\x0b\x0c\x0d"
    assert client.call_function(65, b"\x01\x02\x03\x04") == b""
    with pytest.raises(holdfast.ModbusException) as caught:
        client.call_function(65, b"\x01\x02\x03\x04")
    assert caught.value.code == 4
    client.timeout = 0.3
    with pytest.raises(holdfast.InvalidResponse) as invalid:
        client.call_function(65, b"\x01\x02\x03\x04")
    # The length of an RTU reply of another unknown function is not known.
    assert invalid.value.reason == ("frame" if "rtu" in device.url else "function")
    assert {asked.pdu.hex() for asked in device.requests} == {"4101020304"}


def test_a_function_of_the_devices_own_is_not_sent_twice(dial: Dial) -> None:
    replies: list[Any] = [b"\x41\x01", HANG_UP, b"\x41\x02"]
    with FakeDevice(lambda _: replies.pop(0)) as device:
        client = dial(device.url + "?retries=3")
        assert client.call_function(65) == b"\x01"
        with pytest.raises(holdfast.ConnectionLost):
            client.call_function(65)
        assert client.call_function(65) == b"\x02"
    assert device.asked == [b"\x41"] * 3


@pytest.mark.parametrize("device", ["tcp", "rtu+tcp", "rtu", "ascii"], indirect=True)
def test_the_reply_of_a_known_function_is_checked_and_returned_as_it_came(
    device: ScriptedDevice, dial: Dial
) -> None:
    client = dial(device.url)
    assert client.call_function(3, bytes.fromhex("00070002")) == bytes.fromhex("0400070008")
    assert client.call_function(5, bytes.fromhex("0007ff00")) == bytes.fromhex("0007ff00")

    device.then = lambda asked: asked.answer(bytes.fromhex("03020007"))
    with pytest.raises(holdfast.InvalidResponse) as caught:
        client.call_function(3, bytes.fromhex("00070002"))
    assert caught.value.reason == "length"
    device.then = good
    assert client.read_holding_registers(7, 1) == [7]
