"""Reading tags: how many requests it takes, and what a refused or silent block costs."""

from __future__ import annotations

import itertools
import struct
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast._core import RETRY_REFUSED_AFTER_S
from holdfast.client.tag_reading import RETRY_ONE_AFTER_S, TagReader
from holdfast.errors import ConnectFailed, ModbusException, RequestTimeout
from holdfast.tags import Tag, TagList
from holdfast.tags.scale import RegisterScale
from holdfast.values import ConversionError
from support import cli, wire
from support.fake_device import FakeDevice, exception, registers

if TYPE_CHECKING:
    from collections.abc import Callable


def tag(name: str, address: int, kind: str = "uint16", **more: Any) -> Tag:
    settings: dict[str, Any] = {"area": "holding_registers", **more}
    return Tag(name, address=address, type=kind, **settings)


def asked(device: FakeDevice) -> list[tuple[int, int]]:
    """The address and count of each request."""
    return [struct.unpack(">HH", pdu[1:]) for pdu in device.asked]


def read(device: FakeDevice, reader: TagReader, timeout: float = 5) -> list[Any]:
    with holdfast.SyncClient(device.url, timeout=timeout) as client:
        return [each.error or each.value for each in reader.read(client)]


def without(*absent: int) -> Callable[[bytes], bytes | None]:
    """A device without some registers; every other one holds 7."""

    def answer(pdu: bytes) -> bytes | None:
        address, count = struct.unpack(">HH", pdu[1:])
        if any(address <= each < address + count for each in absent):
            return exception(pdu, 2)
        return registers(pdu, 7)

    return answer


def test_values_of_all_areas_and_types_are_read(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [*holdfast.values.encode(230.1, "float32", "CDAB"), 215])
    memory.write("holding_registers", 3, [0b101])
    memory.write("input_registers", 9, [65535])
    memory.write("coils", 3, [1, 0, 1])
    memory.write("discrete_inputs", 999, [1])
    reader = TagReader(
        [
            tag("text", 3, "bit:2"),
            tag("bit", 3, "bit:1"),
            tag("float", 0, "float32", order="CDAB"),
            tag("scaled", 2, scale=0.1),
            tag("none", 9, area="input_registers", null=frozenset([65535])),
            tag("coil", 5, "bool", area="coils"),
            tag("coils", 3, "bool[2]", area="coils"),
            tag("input", 999, "bool", area="discrete_inputs"),
            tag("long", 0, "uint16[300]"),
        ]
    )
    with holdfast.SyncClient(cli.url(server)) as client:
        found = reader.read(client)
    assert [each.error for each in found] == [None] * 9
    assert [each.tag for each in found] == list(reader.tags)
    *others, long = [each.value for each in found]
    assert others == [True, False, pytest.approx(230.1), 21.5, None, True, [True, False], True]
    assert len(long) == 300
    assert long[2] == 215


def test_neighbours_are_read_with_one_request() -> None:
    with FakeDevice(without()) as device:
        tags = [tag("a", 0), tag("b", 1, "float32"), tag("c", 1), tag("d", 5), tag("e", 7)]
        read(device, TagReader(tags))
        assert asked(device) == [(0, 3), (5, 1), (7, 1)]
    with FakeDevice(without()) as device:
        read(device, TagReader(tags, max_gap=2))
        assert asked(device) == [(0, 8)]


def test_a_refused_block_costs_only_the_tags_that_the_device_refuses() -> None:
    tags = [tag(f"t{address}", address) for address in range(16)]
    moment = 0.0
    with FakeDevice(without(5)) as device:
        reader = TagReader(tags, clock=lambda: moment)
        found = read(device, reader)
        assert [each for each in found if each != 7] == [found[5]]
        assert isinstance(found[5], ModbusException)
        searching = len(device.asked)
        assert searching <= 2 * 4 + 1
        assert str(read(device, reader)[5]) == "exception 02 (Illegal Data Address)"
        again = asked(device)[searching:]
        assert all(not address <= 5 < address + count for address, count in again)
        assert len(again) <= 4


def test_a_refused_tag_is_soon_tried_again_and_merged_after_a_minute() -> None:
    moment = 0.0
    absent = [1]
    with FakeDevice(lambda pdu: without(*absent)(pdu)) as device:
        reader = TagReader([tag("a", 0), tag("b", 1)], clock=lambda: moment)
        assert isinstance(read(device, reader)[1], ModbusException)
        absent.clear()
        moment = RETRY_ONE_AFTER_S - 1
        assert isinstance(read(device, reader)[1], ModbusException)
        moment = RETRY_ONE_AFTER_S
        assert read(device, reader) == [7, 7]
        assert asked(device)[-2:] == [(0, 1), (1, 1)]
        moment = RETRY_REFUSED_AFTER_S
        assert read(device, reader) == [7, 7]
        assert asked(device)[-1] == (0, 2)


@pytest.mark.parametrize("code", [2, 4, None])
def test_refused_tags_cost_one_request_until_the_device_has_one(code: int | None) -> None:
    absent, moment = [2, 4, 6], 0.0
    refuses: list[int | None] = [2]
    """What a tag that is absent gets: an exception, or nothing."""

    def answer(pdu: bytes) -> bytes | None:
        found = without(*absent)(pdu)
        if found is None or not found[0] & 0x80:
            return found
        return None if (with_code := refuses[0]) is None else exception(pdu, with_code)

    with FakeDevice(answer) as device:
        reader = TagReader([tag(f"t{at}", at) for at in (0, *absent)], clock=lambda: moment)
        read(device, reader)
        refuses[0] = code
        for at in (2, 4, 6, 2):
            moment += RETRY_ONE_AFTER_S
            before = len(device.asked)
            assert read(device, reader, timeout=0.3)[0] == 7
            assert asked(device)[before:] == [(0, 1), (at, 1)]
            assert read(device, reader)[0] == 7
            assert asked(device)[before:] == [(0, 1), (at, 1), (0, 1)]
        absent.clear()
        moment += RETRY_ONE_AFTER_S
        assert read(device, reader) == [7] * 4


def test_a_silent_device_is_not_asked_again_for_what_it_has_refused() -> None:
    is_silent, moment = [False], 0.0
    with FakeDevice(lambda pdu: None if is_silent[0] else without(2, 4)(pdu)) as device:
        reader = TagReader([tag(f"t{at}", at) for at in (0, 2, 4)], clock=lambda: moment)
        read(device, reader)
        is_silent[0], moment = True, RETRY_ONE_AFTER_S
        before = len(device.asked)
        read(device, reader, timeout=0.3)
        assert asked(device)[before:] == [(0, 1)]


def test_other_exceptions_are_not_searched_and_not_remembered() -> None:
    busy = [True]
    with FakeDevice(lambda pdu: exception(pdu, 6) if busy else registers(pdu, 7)) as device:
        reader = TagReader([tag("a", 0), tag("b", 1)])
        assert [getattr(each, "code", None) for each in read(device, reader)] == [6, 6]
        assert asked(device) == [(0, 2)]
        busy.clear()
        assert read(device, reader) == [7, 7]


def test_a_device_that_does_not_answer_is_not_asked_for_everything() -> None:
    with FakeDevice(lambda _: None) as device:
        found = read(device, TagReader([tag(f"t{at}", 2 * at) for at in range(20)]), timeout=0.3)
        wire.until(lambda: len(device.asked) == 3, "three requests have come")
    assert {type(each) for each in found} == {RequestTimeout}


def test_blocks_without_an_answer_do_not_keep_others_from_being_read() -> None:
    def answer(pdu: bytes) -> bytes | None:
        address, _ = struct.unpack(">HH", pdu[1:])
        return None if address < 8 else registers(pdu, 7)

    def are_read(timeout: float) -> bool:
        with FakeDevice(answer) as device:
            reader = TagReader([tag(f"t{at}", 2 * at) for at in range(6)])
            found = read(device, reader, timeout)
            assert all(isinstance(each, RequestTimeout) for each in found)
            *silent, fourth, fifth = read(device, reader, timeout)
            assert all(isinstance(each, RequestTimeout) for each in silent)
            if (fourth, fifth) != (7, 7):
                return False
            before = len(device.asked)
            read(device, reader, timeout)
            assert asked(device)[before : before + 2] == [(8, 1), (10, 1)]
            return True

    wire.until_long_enough(are_read, "the others are answered")


def test_a_refused_connection_is_tried_once(unused: str) -> None:
    calls: list[None] = []
    reader = TagReader([tag("a", 0), tag("b", 5)])
    with holdfast.SyncClient(unused, timeout=5) as client:
        found = reader.read(client, lambda: calls.append(None))
    assert [type(each.error) for each in found] == [ConnectFailed] * 2
    assert len(calls) == 1


def test_registers_that_hold_no_value_of_the_type_cost_only_their_tag() -> None:
    with FakeDevice(lambda pdu: registers(pdu, 0xABCD)) as device:
        bcd, number = read(device, TagReader([tag("bcd", 0, "bcd16"), tag("number", 1)]))
    assert isinstance(bcd, ConversionError)
    assert number == 0xABCD


@pytest.fixture
def unused() -> str:
    """A URL where nothing listens."""
    with FakeDevice(without()) as device:
        return device.url


def test_a_value_and_its_scale_are_from_one_request() -> None:
    scale = RegisterScale("exponent", source=tag("", 60, "int16"))
    with FakeDevice(lambda pdu: registers(pdu, 1)) as device:
        reader = TagReader([tag("first", 3), tag("power", 10, scale=scale)])
        assert read(device, reader) == [1, 10]
        assert asked(device) == [(3, 1), (10, 51)]


def test_a_scale_that_moves_never_makes_a_wrong_value() -> None:
    turns = itertools.cycle([(432, 1), (4320, 0), (43200, 0xFFFF)])

    def moving(pdu: bytes) -> bytes:
        """A device that changes both registers between all requests."""
        first, count = struct.unpack(">HH", pdu[1:])
        power, exponent = next(turns)
        whole = {12: power, 13: exponent}
        content = [whole.get(each, 0) for each in range(first, first + count)]
        return bytes([3, 2 * count]) + struct.pack(f">{count}H", *content)

    scale = RegisterScale("exponent", "sf")
    tags = TagList([tag("power", 12, scale=scale), tag("sf", 13, "int16")])
    with FakeDevice(moving) as device:
        reader = TagReader(tags)
        assert [read(device, reader)[0] for _ in range(6)] == [4320] * 6


def test_a_scale_that_is_refused_costs_its_value() -> None:
    scale = RegisterScale("exponent", source=tag("", 12, "int16"))
    with FakeDevice(without(12)) as device:
        found = read(device, TagReader([tag("power", 10, scale=scale), tag("other", 11)]))
        assert [str(found[0])[:12], found[1]] == ["exception 02", 7]


def test_a_number_beside_a_long_text_is_from_one_request() -> None:
    counter = itertools.cycle([[0, 0xFFFF], [1, 0]])

    def moving(pdu: bytes) -> bytes:
        """A device whose counters go from 65535 to 65536 and back between all requests."""
        first, count = struct.unpack(">HH", pdu[1:])
        halves = next(counter)
        content = [halves[each % 2] for each in range(first, first + count)]
        return bytes([3, 2 * count]) + struct.pack(f">{count}H", *content)

    for others in ([tag("text", 0, "string:500")], [tag("texts", 0, "bytes:250[2]")], []):
        with FakeDevice(moving) as device:
            found = read(device, TagReader([tag("counters", 0, "uint32[125]"), *others]))
        assert set(found[0]) == {65535, 65536}
