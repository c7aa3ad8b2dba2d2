"""Batches over several memories, and what the native core says of one that it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast import Memory
from holdfast._core import Batch, BatchRefused
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Iterator

SIZE = 8


def memories() -> list[Memory]:
    """The second is sealed, the third has coils only."""
    sizes: dict[str, Any] = dict.fromkeys(AREAS, SIZE)
    return [Memory(**sizes), Memory(**sizes, seal=("coils", 7, "level")), Memory(coils=SIZE)]


def content(of: list[Memory]) -> list[object]:
    return [
        [[memory.read(area, 0, SIZE) for area in memory.areas], memory.sealed, memory.seal_changes]
        for memory in of
    ]


def refusal(writes: Any) -> tuple[int, int | None, str]:
    with pytest.raises(BatchRefused) as caught:
        Batch(writes).write()
    return caught.value.command, caught.value.index, caught.value.reason


def test_a_batch_returns_how_many_values_it_wrote() -> None:
    first, second, _ = memories()
    written = Batch(
        [(first, "coils", 0, [1, True]), (second, "holding_registers", 1, range(5, 8))]
    ).write()
    assert written == (5, None)
    assert first.read("coils", 0, 3) == [1, 1, 0]
    assert second.read("holding_registers", 0, 5) == [0, 5, 6, 7, 0]
    assert Batch([]).write() == (0, None)


@pytest.mark.parametrize("place", [0, 1, 30])
@pytest.mark.parametrize(
    ("area", "address", "values", "index", "reason"),
    [
        ("holding_registers", 7, [1, 2], None, "out_of_range"),
        ("holding_registers", -1, [1], None, "out_of_range"),
        ("holding_registers", 2**200, [1], None, "out_of_range"),
        ("holding_registers", 0, [1] * 65537, None, "out_of_range"),
        ("holding_registers", 0, [], None, "empty"),
        ("relays", 0, [1], None, "invalid_area"),
        ("holding_registers", 0, [1, 65536], 1, "invalid_value"),
        ("holding_registers", 0, [1, 2, -(10**40)], 2, "invalid_value"),
        ("holding_registers", 0, [True], 0, "invalid_type"),
        ("holding_registers", 0, [1, 1.0], 1, "invalid_type"),
        ("coils", 0, [1, False, 2], 2, "invalid_value"),
        ("coils", 0, [1, "1"], 1, "invalid_type"),
        ("coils", 0, (1, None), 1, "invalid_type"),
        ("coils", 0, "11", None, "invalid_type"),
        ("coils", 0, b"\1", None, "invalid_type"),
        ("coils", 0, 1, None, "invalid_type"),
        ("coils", 0, {1: 0}, None, "invalid_type"),
    ],
)
def test_a_refusal_says_which_write_which_value_and_why(
    area: Any, address: int, values: Any, index: int | None, reason: str, place: int
) -> None:
    all_of = memories()
    before = content(all_of)
    writes: list[Any] = [(all_of[n % 2], "coils", 7, [1]) for n in range(30)]
    writes.insert(place, (all_of[0], area, address, values))
    assert refusal(writes) == (place, index, reason)
    assert content(all_of) == before


def test_a_memory_without_the_area_refuses_any_range() -> None:
    assert refusal([(memories()[2], "input_registers", 0, [1])]) == (0, None, "out_of_range")


def test_a_wrong_range_goes_before_a_wrong_value_of_an_earlier_write() -> None:
    memory = memories()[0]
    writes = [(memory, "coils", 0, [2]), (memory, "coils", 8, [1]), (memory, "coils", 9, [1])]
    assert refusal(writes) == (1, None, "out_of_range")
    assert refusal(writes[:1]) == (0, 0, "invalid_value")


def test_what_an_iterator_raises_goes_before_a_later_write_and_before_all_values() -> None:
    memory = memories()[0]

    def writes(first: int) -> Iterator[Any]:
        yield memory, "coils", first, [2]
        raise KeyError("the next write")

    with pytest.raises(KeyError, match="the next write"):
        Batch(writes(0)).write()
    assert refusal(writes(8)) == (0, None, "out_of_range")
    assert not any(memory.read("coils", 0, SIZE))


def test_values_that_change_while_they_are_read_write_nothing() -> None:
    memory = memories()[0]
    values: list[Any] = []

    class Clearing:
        """An integer that takes the other values away when it is looked at."""

        def __index__(self) -> int:
            values.clear()
            return 1

    values += [1, Clearing(), 1, 1]
    with pytest.raises(IndexError):
        Batch([(memory, "holding_registers", 0, values)]).write()
    assert memory.read("holding_registers", 0, 4) == [0] * 4

    def writes() -> Iterator[Any]:
        others = [1, 1]
        yield memory, "coils", 0, others
        others.append(1)

    with pytest.raises(RuntimeError, match="changed while they were read"):
        Batch(writes()).write()
    assert not any(memory.read("coils", 0, SIZE))


def test_a_batch_refusal_is_a_value_error_with_a_text() -> None:
    assert issubclass(BatchRefused, ValueError)
    with pytest.raises(ValueError, match=r"writes\[0\]: values\[1\]: invalid_value"):
        Batch([(memories()[0], "coils", 0, [0, 2])]).write()


areas = st.sampled_from(AREAS)
bad_values = st.sampled_from([2, -1, 65536, 1.0, None, "1"])


@st.composite
def a_write(draw: st.DrawFn, bad: bool) -> tuple[int, Any, int, list[Any]]:
    """Which memory, and the rest of a write that is mostly right."""
    which = draw(st.integers(0, 2))
    area: Any = "coils" if which == 2 else draw(areas)
    address = draw(st.integers(0, SIZE - 1))
    size = draw(st.integers(1, SIZE - address))
    most = 1 if area in BIT_AREAS else 65535
    values: list[Any] = draw(st.lists(st.integers(0, most), min_size=size, max_size=size))
    if bad:
        kind = draw(st.sampled_from(["range", "empty", "area", "value"]))
        if kind == "range":
            address = SIZE - size + 1
        elif kind == "empty":
            values = []
        elif kind == "area":
            area = "relays"
        else:
            values[draw(st.integers(0, size - 1))] = draw(bad_values)
    return which, area, address, values


def expected_refusal(batch: list[tuple[int, Any, int, list[Any]]]) -> object:
    """The first write whose place is wrong, then the first value that is wrong."""
    for command, (_, area, address, values) in enumerate(batch):
        if area not in AREAS:
            return command, None, "invalid_area"
        if not values:
            return command, None, "empty"
        if address + len(values) > SIZE:
            return command, None, "out_of_range"
    for command, (_, area, _, values) in enumerate(batch):
        most = 1 if area in BIT_AREAS else 65535
        for index, value in enumerate(values):
            if type(value) is not int:
                return command, index, "invalid_type"
            if not 0 <= value <= most:
                return command, index, "invalid_value"
    return None


@given(
    batch=st.lists(a_write(False), max_size=40),
    bad=st.lists(st.tuples(st.integers(0, 40), a_write(True)), max_size=3),
)
def test_a_batch_is_written_in_order_or_refused_as_a_whole(
    batch: list[Any], bad: list[tuple[int, Any]]
) -> None:
    for place, write in bad:
        batch.insert(place, write)
    all_of, one_by_one = memories(), memories()
    before = content(all_of)
    writes = [(all_of[which], *write) for which, *write in batch]
    expected = expected_refusal(batch)
    if expected is not None:
        assert refusal(writes) == expected
        assert content(all_of) == before
        return
    assert Batch(writes).write() == (sum(len(values) for *_, values in batch), None)
    for which, area, address, values in batch:
        one_by_one[which].write(area, address, values)
    for batched, single in zip(all_of, one_by_one, strict=True):
        assert [batched.read(area, 0, SIZE) for area in batched.areas] == [
            single.read(area, 0, SIZE) for area in single.areas
        ]
        assert batched.sealed == single.sealed


def test_a_write_can_require_that_all_memories_of_the_batch_are_sealed() -> None:
    sealed, other = (Memory(coils=8, holding_registers=8, seal=("coils", 0)) for _ in range(2))
    only: Any = (sealed, "holding_registers", 0, [7], True)
    both = Batch([only, (other, "holding_registers", 0, [8])])
    assert both.can_be_refused
    assert both.write() == (2, None)
    one = Batch([(other, "coils", 0, [1])])
    assert not one.can_be_refused
    assert one.write() == (1, None)
    assert refusal([only, (other, "holding_registers", 0, [9])]) == (1, None, "unsealed")
    assert refusal([(other, "coils", 0, [1], True)]) == (0, None, "unsealed")
    assert Batch([(other, "coils", 0, [1], False)]).write() == (1, None)
    assert Batch([only, (sealed, "coils", 0, [1])]).write() == (2, None)
    assert refusal([only]) == (0, None, "unsealed")
    assert other.read("holding_registers", 0, 1) == [8]


@pytest.mark.parametrize("write", [[], (1, 2, 3), "text", (1, 2, 3, 4, 5, 6)])
def test_what_is_no_write_is_a_type_error(write: object) -> None:
    with pytest.raises((TypeError, ValueError)):
        Batch([write]).write()  # type: ignore[list-item]
