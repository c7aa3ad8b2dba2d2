"""The gateway's streams: watching what changes, and mapping a device."""

from __future__ import annotations

import struct
import threading
from math import nan
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import pytest

import holdfast
from holdfast.types import AREAS
from support import gateways, wire
from support.event_streams import EventStream
from support.fake_device import HANG_UP, FakeDevice, exception, registers
from support.gateways import Running

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support.running import Serve

SOON = 0.01
"""Seconds from poll to poll."""


@pytest.fixture
def gateway() -> Iterator[Running]:
    with gateways.running(limits={"interval": SOON}) as started:
        yield started


def watch(gateway: Running, port: int, **query: Any) -> EventStream:
    """A watch of holding registers from 0 on."""
    usual = {"host": "127.0.0.1", "port": port, "functionCode": 3, "address": 0, "interval": 10}
    return gateway.stream("GET", f"/watch?{urlencode({**usual, **query})}")


def mapped(gateway: Running, port: int, **body: Any) -> EventStream:
    return gateway.stream("POST", "/map", {"host": "127.0.0.1", "port": port, **body})


def is_free(gateway: Running, port: int) -> bool:
    """Whether there is a place for a stream."""
    stream = watch(gateway, port)
    stream.close()
    return stream.status == 200


# Watching.


def test_a_watch_tells_everything_and_then_what_changes(
    gateway: Running, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [1, 2, 3])
    stream = watch(gateway, server.address[1], quantity=3)
    assert (stream.status, stream.kind) == (200, "text/event-stream")
    first = stream.next("values")
    assert (first.pop("time") > 0, first.pop("rtt") >= 0) == (True, True)
    assert first == {"address": 0, "quantity": 3, "format": "registers", "values": [1, 2, 3]}
    memory.write("holding_registers", 0, [7, 2, 9])
    changes = [{"address": 0, "value": 7}, {"address": 2, "value": 9}]
    second = stream.next("change")
    assert second["changes"] == changes
    assert "typed" not in second
    memory.write("holding_registers", 1, [5])
    assert stream.next("change")["changes"] == [{"address": 1, "value": 5}]


def test_typed_values_change_as_a_whole(
    gateway: Running, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    def written(*values: float) -> list[int]:
        data = struct.pack(f">{len(values)}f", *values)
        return list(struct.unpack(f">{2 * len(values)}H", data))

    memory.write("holding_registers", 10, written(1.5, 2.5, 0.1))
    port = server.address[1]
    stream = watch(gateway, port, address=10, quantity=6, datatype="float32")
    assert stream.next("values")["typedText"] == ["1.5", "2.5", "0.1"]
    memory.write("holding_registers", 12, written(2.25))
    change = stream.next("change")
    assert change["typed"] == [{"index": 1, "value": 2.25, "text": "2.25"}]
    assert [each["address"] for each in change["changes"]] == [12]
    memory.write("holding_registers", 12, written(nan))
    error = "not a number"
    change = stream.next("change")
    assert change["typed"] == [{"index": 1, "value": None, "text": "nan", "error": error}]


def test_bits_are_watched(
    gateway: Running, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    stream = watch(gateway, server.address[1], functionCode=1, quantity=2)
    assert stream.next("values")["values"] == [False, False]
    memory.write("coils", 1, [1])
    assert stream.next("change")["changes"] == [{"address": 1, "value": True}]


def test_a_problem_is_told_once_and_what_is_there_afterwards(gateway: Running) -> None:
    replies: Iterator[int | None] = iter([5, *[None] * 3, 4, 4])

    def answer(pdu: bytes) -> bytes:
        value = next(replies, 6)
        return exception(pdu, 6) if value is None else registers(pdu, value)

    with FakeDevice(answer) as device:
        stream = watch(gateway, device.port)
        names = []
        for event in stream:
            names.append(event.name)
            if event.name == "problem":
                assert event.data["reason"] == "exception"
                assert event.data["error"] == "Modbus exception: Server Device Busy (code 0x6)"
            if event.name == "change":
                assert event.data["changes"] == [{"address": 0, "value": 6}]
                break
        assert names == ["values", "problem", "values", "change"]


def test_a_device_that_is_gone_for_a_while_comes_back(gateway: Running) -> None:
    def answer(pdu: bytes) -> bytes:
        return HANG_UP if len(device.asked) in (2, 3, 4) else registers(pdu)

    with FakeDevice(answer) as device:
        stream = watch(gateway, device.port)
        stream.next("values")
        assert stream.next("problem")["reason"] == "connection_lost"
        assert stream.next("values")["values"] == [0]


def test_an_address_that_is_not_there_is_a_problem(
    gateway: Running, server: holdfast.Server
) -> None:
    told = watch(gateway, server.address[1], address=5000).next("problem")
    assert told["error"] == "Modbus exception: Illegal Data Address (code 0x2)"


def test_a_device_that_is_not_there_is_no_stream(gateway: Running) -> None:
    with FakeDevice(registers) as device:
        port = device.port
    stream = watch(gateway, port)
    assert (stream.status, stream.kind) == (500, "application/json")
    assert stream.reply.headers["holdfast-reason"] == "no_connection"


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ({"interval": 9}, "interval is 9, allowed: an integer 10 to 3600000"),
        ({"interval": "1e3"}, "interval"),
        ({"address": "0x0"}, "address"),
        ({"quantity": 126}, "Quantity must be between 1 and 125"),
        ({"every": 5}, '"every" is not a parameter'),
        ({"functionCode": 6}, "Invalid read function code: 0x6"),
        ({"datatype": "float32", "quantity": 3}, "multiple of 2"),
    ],
)
def test_a_watch_that_can_not_be_is_refused(
    gateway: Running, query: dict[str, Any], says: str
) -> None:
    usual = {"host": "127.0.0.1", "functionCode": 3, "address": 0}
    answer = gateway.client().get(f"/api/modbus/watch?{urlencode({**usual, **query})}")
    assert answer.status == 400
    assert says in answer.json["error"]


def test_a_parameter_that_is_given_twice_is_refused(gateway: Running) -> None:
    answer = gateway.client().get("/api/modbus/watch?host=a&host=b&functionCode=3&address=0")
    assert (answer.status, answer.json["error"]) == (400, "host is given more than once")


def test_while_nothing_changes_there_are_signs_of_life(server: holdfast.Server) -> None:
    with gateways.running(limits={"interval": SOON, "heartbeat": 0.02}) as gateway:
        events = iter(watch(gateway, server.address[1], interval=60000))
        assert [next(events).name for _ in range(4)] == ["values", ":", ":", ":"]


def test_while_a_device_is_waited_for_there_are_signs_of_life() -> None:
    def answer(pdu: bytes) -> bytes | None:
        return registers(pdu) if len(device.asked) == 1 else None

    limits = {"interval": SOON, "heartbeat": 0.02}
    with FakeDevice(answer) as device, gateways.running(limits=limits) as gateway:
        events = iter(watch(gateway, device.port, timeout=60000))
        assert [next(events).name for _ in range(4)] == ["values", ":", ":", ":"]
        assert len(device.asked) == 2


def test_a_watch_ends_when_its_client_goes(server: holdfast.Server) -> None:
    port = server.address[1]
    with gateways.running(limits={"streams": 1, "interval": SOON}) as gateway:
        stream = watch(gateway, port)
        stream.next("values")
        assert not is_free(gateway, port)
        stream.close()
        wire.until(lambda: is_free(gateway, port), "its place is free")


def test_a_watch_leaves_room_for_other_requests(gateway: Running, server: holdfast.Server) -> None:
    port = server.address[1]
    stream = watch(gateway, port)
    stream.next("values")
    body = {"host": "127.0.0.1", "port": port, "address": 0, "value": 77}
    assert gateway.ask("/write/register", body).json["success"] is True
    assert stream.next("change")["changes"] == [{"address": 0, "value": 77}]
    assert gateway.client().get("/api/gateway").json["connections"] == 1


# Mapping.


def ranges(result: Any) -> dict[str, list[list[int]]]:
    return {area["area"]: area["ranges"] for area in result["areas"]}


def test_a_map_tells_the_ranges_of_all_areas(gateway: Running, serve: Serve) -> None:
    plant = holdfast.Memory(
        coils=(0, 17), discrete_inputs=(1000, 3), holding_registers=(99, 200), input_registers=5
    )
    stream = mapped(gateway, serve({1: plant}).address[1])
    assert (stream.status, stream.kind) == (200, "text/event-stream")
    events = [event for event in stream if event.name != ":"]
    *progress, last = events
    assert {event.name for event in progress} == {"progress"}
    assert last.name == "result"
    assert last.data["success"] is True
    assert (last.data["first"], last.data["last"], last.data["exact"]) == (0, 65535, False)
    assert last.data["requests"] == sum(area["requests"] for area in last.data["areas"])
    assert ranges(last.data) == {
        "coils": [[0, 16]],
        "discrete_inputs": [[1000, 1002]],
        "holding_registers": [[99, 298]],
        "input_registers": [[0, 4]],
    }
    assert [area["addresses"] for area in last.data["areas"]] == [17, 3, 200, 5]
    told = progress[0].data
    assert (told["at"], told["total"]) == (0, 4 * 65536)
    assert [area["area"] for area in told["areas"]] == list(AREAS)
    assert [area["notSearchedFrom"] for area in told["areas"]] == [0] * 4
    assert [area["notSearchedFrom"] for area in last.data["areas"]] == [None] * 4


def test_a_map_tells_ranges_before_it_ends_registers_first(gateway: Running) -> None:
    reached, go_on = threading.Event(), threading.Event()

    def answer(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] < 3:
            reached.set()
            go_on.wait(wire.DEADLINE)
        return registers(pdu) if pdu[0] >= 3 and first + count <= 8 else exception(pdu, 2)

    with FakeDevice(answer) as device:
        stream = mapped(gateway, device.port, last=20)
        assert reached.wait(wire.DEADLINE)
        found: list[Any] = []
        while len(found) < 2:
            told = stream.next("progress")
            found += told["found"]
        go_on.set()
        result = stream.next("result")
    assert found == [
        {"area": area, "first": 0, "last": 7} for area in ("holding_registers", "input_registers")
    ]
    assert result["success"] is True


def test_a_map_can_be_of_a_part_and_exact(gateway: Running, serve: Serve) -> None:
    plant = holdfast.Memory(holding_registers=(37, 2))
    options = {"areas": ["holding_registers"], "first": 30, "last": 45, "exact": True}
    result = mapped(gateway, serve({1: plant}).address[1], **options).next("result")
    assert ranges(result) == {"holding_registers": [[37, 38]]}
    assert (result["exact"], result["first"], result["last"]) == (True, 30, 45)


def test_what_fails_otherwise_is_told_apart(gateway: Running) -> None:
    def answer(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if first <= 3 < first + count:
            return exception(pdu, 4)
        return registers(pdu) if first + count <= 8 else exception(pdu, 2)

    with FakeDevice(answer) as device:
        options = {"areas": ["holding_registers"], "last": 20, "exact": True}
        [area] = mapped(gateway, device.port, **options).next("result")["areas"]
    assert area["ranges"] == [[0, 2], [4, 7]]
    assert area["failures"] == {"4": [[3, 3]]}


def test_only_the_areas_that_are_asked_for_are_read(gateway: Running) -> None:
    def answer(pdu: bytes) -> bytes | None:
        if pdu[0] != 4:
            return None
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return registers(pdu) if first + count <= 8 else exception(pdu, 2)

    with FakeDevice(answer) as device:
        asked = {"areas": ["input_registers"], "last": 20}
        [area] = mapped(gateway, device.port, **asked).next("result")["areas"]
        assert area["ranges"] == [[0, 7]]
        assert {pdu[0] for pdu in device.asked} == {4}
        asked = {"areas": ["holding_registers", "input_registers"], "last": 20, "timeout": 500}
        result = mapped(gateway, device.port, **asked).next("result")
        assert result["success"] is True
        assert [each["area"] for each in result["areas"]] == asked["areas"]
        assert [each["ranges"] for each in result["areas"]] == [[], [[0, 7]]]


def test_a_device_that_is_silent_is_no_map(gateway: Running) -> None:
    with FakeDevice(lambda _: None) as device:
        stream = mapped(gateway, device.port, timeout=50)
        assert (stream.status, stream.kind) == (500, "application/json")


@pytest.mark.parametrize("end", [HANG_UP, None], ids=["hangs-up", "silent"])
def test_a_device_that_stops_answering_ends_its_map(gateway: Running, end: bytes | None) -> None:
    stopped = threading.Event()

    def answer(pdu: bytes) -> bytes | None:
        if int.from_bytes(pdu[1:3]) >= 1000:
            stopped.set()
        return end if stopped.is_set() else registers(pdu)

    with FakeDevice(answer) as device:
        options = {"areas": ["holding_registers"], "timeout": 1000}
        result = mapped(gateway, device.port, **options).next("result")
    assert result["success"] is False
    assert "stopped answering" in result["error"]
    assert result["reason"] == "timeout"
    assert result["areas"][0]["notSearchedFrom"] == 0
    [[first, last]] = result["areas"][0]["ranges"]
    assert first == 0
    assert last > 100


def test_a_map_has_a_longest_time() -> None:
    with (
        gateways.running(limits={"discovery": 0.1}) as gateway,
        FakeDevice(lambda pdu: exception(pdu, 2)) as device,
    ):
        result = mapped(gateway, device.port, exact=True).next("result")
    assert (result["success"], result["error"]) == (False, "not finished within 0.1 s")
    assert result["reason"] == "unfinished"


def test_a_map_ends_when_its_client_goes() -> None:
    with (
        gateways.running(limits={"streams": 1, "interval": SOON}) as gateway,
        FakeDevice(lambda pdu: exception(pdu, 2)) as device,
    ):
        stream = mapped(gateway, device.port, exact=True)
        stream.next("progress")
        stream.close()
        wire.until(lambda: is_free(gateway, device.port), "its place is free")


def test_the_end_of_the_gateway_ends_streams(server: holdfast.Server) -> None:
    with gateways.running() as gateway:
        stream = watch(gateway, server.address[1], interval=1000)
        stream.next("values")
        gateway.stop.set()
        assert list(stream) == []
