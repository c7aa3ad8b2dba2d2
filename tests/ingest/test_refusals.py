"""What a memory access answers when it refuses, and which refusal of several."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import msgspec
import pytest

import holdfast
from holdfast.ingest import Grant, MemoryAccess, Refused
from holdfast.types import AREAS

GRANT = Grant("edge", ("plant", "other"), AREAS)


@pytest.fixture
def plant() -> holdfast.Memory:
    return holdfast.Memory(coils=16, holding_registers=(10, 90))


@pytest.fixture
def memory_access(plant: holdfast.Memory) -> MemoryAccess:
    return MemoryAccess("rest", {"plant": plant, "other": plant, "hidden": plant})


def command(address: Any, values: Any, area: str = "holding_registers", **more: Any) -> Any:
    return {"memory": "plant", "area": area, "address": address, "values": values, **more}


GOOD = command(20, [7])
BAD_VALUE = command(20, [1, 70000])
BAD_RANGE = command(99, [1, 2])
EMPTY = command(20, [])
UNKNOWN_KEY = command(20, [1], unit=1)
UNKNOWN_MEMORY = {**GOOD, "memory": "none"}


def refused(memory_access: MemoryAccess, *batch: Any, grant: Grant = GRANT) -> Refused:
    with pytest.raises(Refused) as caught:
        memory_access.write(batch, grant, "10.0.0.7:50000")
    return caught.value


@pytest.mark.parametrize(
    ("bad", "reason", "index", "detail"),
    [
        (BAD_VALUE, "invalid_value", 1, "values[1] is 70000, outside 0..65535"),
        (command(20, [-1]), "invalid_value", 0, "values[0] is -1, outside 0..65535"),
        (command(20, [10**30]), "invalid_value", 0, f"values[0] is {10**30}, outside 0..65535"),
        (command(20, [1.5]), "invalid_value", 0, "values[0] is 1.5, not 0..65535"),
        (command(20, [True]), "invalid_value", 0, "values[0] is true, not 0..65535"),
        (command(20, [None]), "invalid_value", 0, "values[0] is null, not 0..65535"),
        (command(20, [[1]]), "invalid_value", 0, "values[0] is an array, not 0..65535"),
        (
            command(0, [0, 2], "coils"),
            "invalid_value",
            1,
            "values[1] is 2, not 0, 1, false or true",
        ),
        (
            command(0, ["1"], "coils"),
            "invalid_value",
            0,
            'values[0] is "1", not 0, 1, false or true',
        ),
        (
            BAD_RANGE,
            "out_of_range",
            None,
            "2 from address 99 of holding_registers, allowed: 1 to 1",
        ),
        (
            command(9, [1]),
            "out_of_range",
            None,
            "1 from address 9 of holding_registers, allowed: addresses 10 to 99",
        ),
        (
            command(0, [1], "input_registers"),
            "out_of_range",
            None,
            "1 from address 0 of input_registers, but plant has no input_registers",
        ),
        (EMPTY, "malformed", None, "values are empty"),
        (command(20, {"0": 1}), "malformed", None, "values are an object, not an array"),
        (command("20", [1]), "malformed", None, 'address is "20", not an integer'),
    ],
    ids=str,
)
@pytest.mark.parametrize("place", [None, 0, 2])
def test_a_refusal_names_the_command_and_the_value(
    memory_access: MemoryAccess,
    plant: holdfast.Memory,
    bad: Any,
    reason: str,
    index: int | None,
    detail: str,
    place: int | None,
) -> None:
    batch = [bad] if place is None else [GOOD, GOOD, GOOD]
    if place is not None:
        batch[place] = bad
    body = msgspec.json.encode(batch[0] if place is None else batch)
    with pytest.raises(Refused) as caught:
        memory_access.ingest(body, GRANT, "10.0.0.7:50000")
    where = {} if place is None else {"command": place}
    expected = {
        "status": "rejected",
        "reason": reason,
        **where,
        **({} if index is None else {"index": index}),
        "detail": detail if place is None else f"commands[{place}]: {detail}",
    }
    assert caught.value.answer() == expected
    assert not any(plant.read("holding_registers", 10, 90) + plant.read("coils", 0, 16))


@pytest.mark.parametrize(
    ("batch", "place", "reason"),
    [
        ([BAD_RANGE, UNKNOWN_KEY], 0, "out_of_range"),
        ([BAD_RANGE, UNKNOWN_MEMORY], 0, "out_of_range"),
        ([EMPTY, UNKNOWN_KEY], 0, "malformed"),
        ([UNKNOWN_MEMORY, BAD_RANGE], 0, "unknown_memory"),
        ([BAD_VALUE, UNKNOWN_KEY], 1, "malformed"),
        ([BAD_VALUE, UNKNOWN_MEMORY], 1, "unknown_memory"),
        ([BAD_VALUE, BAD_RANGE], 1, "out_of_range"),
        ([BAD_VALUE, EMPTY], 1, "malformed"),
        ([GOOD, BAD_VALUE, BAD_VALUE], 1, "invalid_value"),
    ],
)
def test_of_several_refusals_values_come_last(
    memory_access: MemoryAccess, batch: list[Any], place: int, reason: str
) -> None:
    found = refused(memory_access, *batch)
    assert (found.where["command"], found.reason) == (place, reason)
    assert memory_access.counts()["refused"] == {reason: 1}


@pytest.mark.parametrize(
    ("changed", "reason", "detail"),
    [
        ({"memory": "none"}, "unknown_memory", 'no memory "none"'),
        ({"memory": "hidden"}, "not_granted", "memory hidden is not granted to edge"),
        (
            {"area": "relays"},
            "invalid_area",
            'area is "relays", allowed: coils, discrete_inputs, holding_registers, input_registers',
        ),
        ({"area": "coils"}, "not_granted", "area coils is not granted to edge"),
    ],
)
def test_what_is_not_granted_is_refused_for_writes_and_reads(
    memory_access: MemoryAccess, changed: dict[str, str], reason: str, detail: str
) -> None:
    grant = Grant("edge", ("plant",), ("holding_registers",))
    asked = {**GOOD, **changed}
    found = refused(memory_access, asked, grant=grant)
    assert (found.reason, found.detail) == (reason, f"commands[0]: {detail}")
    with pytest.raises(Refused) as caught:
        memory_access.read(asked["memory"], asked["area"], 20, 1, grant, "-")
    assert (caught.value.reason, caught.value.detail) == (reason, detail)


@pytest.mark.parametrize(
    ("address", "count", "allowed"),
    [
        (10, 91, "allowed: 1 to 90"),
        (20, 0, "allowed: 1 to 80"),
        (20, -5, "allowed: 1 to 80"),
        (100, 1, "allowed: addresses 10 to 99"),
        (9, 0, "allowed: addresses 10 to 99"),
        (-1, 1, "allowed: addresses 10 to 99"),
        (20, 10**30, "allowed: 1 to 80"),
    ],
)
def test_a_read_outside_is_refused_and_counted(
    memory_access: MemoryAccess, address: int, count: int, allowed: str
) -> None:
    with pytest.raises(Refused) as caught:
        memory_access.read("plant", "holding_registers", address, count, GRANT, "-")
    expected = f"{count} from address {address} of holding_registers, {allowed}"
    assert (caught.value.reason, caught.value.detail) == ("out_of_range", expected)
    assert memory_access.counts()["reads"] == 0
    assert memory_access.counts()["refused"] == {"out_of_range": 1}


class Level(IntEnum):
    LOW = 7
    TOO_HIGH = 70000


def test_any_integer_type_is_a_value(memory_access: MemoryAccess, plant: holdfast.Memory) -> None:
    memory_access.write([command(20, [Level.LOW, 8])], GRANT, "-")
    assert plant.read("holding_registers", 20, 2) == [7, 8]
    found = refused(memory_access, command(20, [Level.LOW, Level.TOO_HIGH]))
    assert (found.where["index"], found.reason) == (1, "invalid_value")


def test_a_value_that_json_does_not_have_is_refused_in_words(memory_access: MemoryAccess) -> None:
    found = refused(memory_access, command(20, [7, object()]))
    assert (found.where["index"], found.reason) == (1, "invalid_value")
    assert found.detail.startswith('commands[0]: values[1] is "<object object at ')


def test_text_that_is_not_utf_8_is_refused_without_a_position(memory_access: MemoryAccess) -> None:
    with pytest.raises(Refused) as caught:
        memory_access.ingest(b'{"memory": "plant\xff"}', GRANT, "-")
    assert caught.value.detail == "not JSON: a string is not UTF-8"


def test_a_byte_order_mark_is_named(memory_access: MemoryAccess) -> None:
    for body in (b"\xef\xbb\xbf{}", b"hello"):
        with pytest.raises(Refused, match=r"invalid character \(byte 0\)") as caught:
            memory_access.ingest(body, GRANT, "-")
        assert ("byte order mark" in caught.value.detail) == (body != b"hello")


def test_reasons_beyond_a_limit_are_counted_together(memory_access: MemoryAccess) -> None:
    """An adapter of another package may make its reasons from what it receives."""
    for number in [*range(100), 0, 99]:
        memory_access.note(Refused(f"reason {number}", "-"), "edge", "-")
    counted: Any = memory_access.counts()["refused"]
    assert (len(counted), sum(counted.values())) == (65, 102)
    assert (counted["reason 0"], counted["reason 63"], counted["other"]) == (2, 1, 37)
