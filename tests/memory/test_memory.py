"""The memory as Python sees it: areas, ranges, values, batches, the seal, and many threads."""

from __future__ import annotations

import ctypes
import random
import re
import sys
import threading
from collections import UserDict, UserList
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest

import holdfast
from holdfast.types import AREAS
from support.running import content
from support.wire import rounds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.types import Area

Wrong: TypeAlias = Any
"""What a type checker would refuse, passed on purpose."""

BIT_AREAS: tuple[Area, ...] = ("coils", "discrete_inputs")
REGISTER_AREAS: tuple[Area, ...] = ("holding_registers", "input_registers")

each_area = pytest.mark.parametrize("area", AREAS)
each_bit_area = pytest.mark.parametrize("area", BIT_AREAS)
each_register_area = pytest.mark.parametrize("area", REGISTER_AREAS)


class Table:
    """As a `DataFrame` of pandas: it has rows, and yields the names of its columns."""

    ndim = 2

    def __iter__(self) -> Iterator[int]:
        return iter([0])


class Column(UserList[int]):
    """As a `Series` of pandas: it has keys, and yields its values."""

    ndim = 1

    def keys(self) -> list[str]:
        return ["a", "b"]


def of_one_area(area: Area, start: int, size: int) -> holdfast.Memory:
    extents = {other: (start, size) if other == area else None for other in AREAS}
    return holdfast.Memory(
        coils=extents["coils"],
        discrete_inputs=extents["discrete_inputs"],
        holding_registers=extents["holding_registers"],
        input_registers=extents["input_registers"],
    )


# Areas


@each_area
def test_all_items_are_0_at_first(area: Area, memory: holdfast.Memory) -> None:
    assert memory.read(area, 0, 1000) == [0] * 1000


@each_area
def test_what_is_written_is_read(area: Area, memory: holdfast.Memory) -> None:
    memory.write(area, 10, [1, 0, 1, 1])

    assert memory.read(area, 9, 6) == [0, 1, 0, 1, 1, 0]


@each_area
def test_a_write_changes_no_other_area(area: Area, memory: holdfast.Memory) -> None:
    memory.write(area, 0, [1] * 1000)

    others = {other: values for other, values in content(memory).items() if other != area}
    assert others == {other: [0] * 1000 for other in AREAS if other != area}


def test_areas_are_told_with_their_addresses() -> None:
    memory = holdfast.Memory(coils=8, input_registers=(100, 20))

    assert memory.areas == {"coils": range(8), "input_registers": range(100, 120)}


@each_area
@pytest.mark.parametrize("start", [0, 1, 7, 8, 65531])
def test_an_area_has_its_first_and_its_last_address(area: Area, start: int) -> None:
    memory = of_one_area(area, start, 5)

    memory.write(area, start, [1])
    memory.write(area, start + 4, [1])

    assert memory.read(area, start, 5) == [1, 0, 0, 0, 1]


@each_area
@pytest.mark.parametrize(
    ("address", "count"),
    [(9, 1), (9, 2), (15, 1), (14, 2), (10, 6), (0, 1), (65535, 1), (65535, 2)],
)
def test_a_range_outside_its_area_is_out_of_range(area: Area, address: int, count: int) -> None:
    memory = of_one_area(area, 10, 5)

    with pytest.raises(holdfast.OutOfRange, match=f"{area}.*10 to 14"):
        memory.read(area, address, count)
    with pytest.raises(holdfast.OutOfRange, match=f"{area}.*10 to 14"):
        memory.write(area, address, [1] * count)
    assert memory.read(area, 10, 5) == [0] * 5


@each_area
def test_an_area_that_was_left_out_does_not_exist(area: Area) -> None:
    other: Area = "coils" if area != "coils" else "holding_registers"
    memory = of_one_area(other, 0, 10)

    with pytest.raises(holdfast.OutOfRange, match=f"no {area}"):
        memory.read(area, 0, 1)
    with pytest.raises(holdfast.OutOfRange, match=f"no {area}"):
        memory.write(area, 0, [1])


def test_out_of_range_is_an_index_error() -> None:
    assert issubclass(holdfast.OutOfRange, IndexError)


@pytest.mark.parametrize("address", [-1, -65536, 65536, 2**31, 2**63, 2**64, -(2**70)])
def test_an_address_that_no_16_bits_hold_is_out_of_range(
    address: int, memory: holdfast.Memory
) -> None:
    with pytest.raises(holdfast.OutOfRange):
        memory.read("coils", address, 1)
    with pytest.raises(holdfast.OutOfRange):
        memory.write("coils", address, [1])


@pytest.mark.parametrize("count", [0, -1, -(2**70)])
def test_a_count_below_1_is_a_value_error(count: int, memory: holdfast.Memory) -> None:
    with pytest.raises(ValueError, match="count"):
        memory.read("coils", 0, count)


@pytest.mark.parametrize("count", [1001, 65536, 65537, 2**32, 2**63, 2**70])
def test_a_count_beyond_the_area_is_out_of_range(count: int, memory: holdfast.Memory) -> None:
    with pytest.raises(holdfast.OutOfRange):
        memory.read("holding_registers", 0, count)


@each_area
def test_an_area_may_have_all_65536_addresses(area: Area) -> None:
    memory = of_one_area(area, 0, 65536)
    values = [index % 3 % 2 for index in range(65536)]

    memory.write(area, 0, values)

    assert memory.read(area, 0, 65536) == values
    assert memory.read(area, 65535, 1) == values[-1:]


@each_area
@pytest.mark.parametrize(
    ("start", "size"),
    [(0, 65537), (1, 65536), (65535, 2), (0, 2**31), (0, -1), (0, 2**200), (65536, 1), (-1, 1)],
)
def test_an_area_beyond_address_65535_is_a_value_error(area: Area, start: int, size: int) -> None:
    with pytest.raises(ValueError, match=area):
        of_one_area(area, start, size)


@pytest.mark.parametrize("extent", ["10", 1.5, (1, 2, 3), (1,), [1.0, 2.0], {}])
def test_an_extent_of_another_type_is_a_type_error(extent: Wrong) -> None:
    found = re.escape(f"size of coils is {extent!r}, allowed: an integer, or (start, size)")
    with pytest.raises(TypeError, match=found):
        holdfast.Memory(coils=extent)


def test_an_unknown_area_is_a_value_error_that_names_the_known_ones(
    memory: holdfast.Memory,
) -> None:
    unknown: Wrong = "coil"

    with pytest.raises(ValueError, match=r"coil.*coils, discrete_inputs, holding_registers"):
        memory.read(unknown, 0, 1)
    with pytest.raises(ValueError, match=r"coil.*coils, discrete_inputs, holding_registers"):
        memory.write(unknown, 0, [1])


@each_bit_area
def test_ranges_of_bits_need_not_begin_or_end_at_a_byte(area: Area) -> None:
    memory = of_one_area(area, 3, 200)
    expected = dict.fromkeys(range(3, 203), 0)
    chance = random.Random(20251121)
    for _ in range(300):
        address = chance.randrange(3, 203)
        bits = [chance.randrange(2) for _ in range(chance.randrange(1, 204 - address))]
        memory.write(area, address, bits)
        expected.update(enumerate(bits, address))
        start = chance.randrange(3, 203)
        count = chance.randrange(1, 204 - start)
        assert memory.read(area, start, count) == [expected[start + at] for at in range(count)]


# Values


@each_bit_area
def test_bools_are_bits(area: Area, memory: holdfast.Memory) -> None:
    memory.write(area, 0, [True, False, 1, 0])

    read = memory.read(area, 0, 4)

    assert read == [1, 0, 1, 0]
    assert {type(bit) for bit in read} == {int}


@each_register_area
def test_a_register_holds_0_to_65535(area: Area, memory: holdfast.Memory) -> None:
    memory.write(area, 0, [0, 1, 255, 256, 32767, 32768, 65535])

    assert memory.read(area, 0, 7) == [0, 1, 255, 256, 32767, 32768, 65535]


@each_bit_area
@pytest.mark.parametrize("value", [2, -1, 255, 65536, 2**63, 2**200, -(2**200)])
def test_a_number_that_is_no_bit_is_a_value_error(
    area: Area, value: int, memory: holdfast.Memory
) -> None:
    with pytest.raises(ValueError, match=r"values\[1\]"):
        memory.write(area, 0, [1, value])
    assert memory.read(area, 0, 2) == [0, 0]


@each_register_area
@pytest.mark.parametrize("value", [-1, 65536, 2**31, 2**63, 2**200, -(2**200)])
def test_a_number_that_no_register_holds_is_a_value_error(
    area: Area, value: int, memory: holdfast.Memory
) -> None:
    with pytest.raises(ValueError, match=r"values\[1\].*0 to 65535"):
        memory.write(area, 0, [1, value])
    assert memory.read(area, 0, 2) == [0, 0]


@each_area
@pytest.mark.parametrize("value", [1.0, "1", None, b"1", [1], 1j])
def test_a_value_of_another_type_is_a_type_error(
    area: Area, value: Wrong, memory: holdfast.Memory
) -> None:
    with pytest.raises(TypeError, match=r"values\[1\]"):
        memory.write(area, 0, [1, value])
    assert memory.read(area, 0, 2) == [0, 0]


@each_register_area
def test_a_bool_is_no_register(area: Area, memory: holdfast.Memory) -> None:
    with pytest.raises(TypeError, match=r"values\[0\]"):
        memory.write(area, 0, [True])


@each_area
@pytest.mark.parametrize(
    "values",
    [
        "101",
        b"\x01\x00",
        bytearray(b"\x01"),
        memoryview(b"\x01").cast("c"),
        memoryview(bytes(8)).cast("H", [2, 2]),
        1,
        None,
        {1: 0},
        MappingProxyType({1: 0}),
        UserDict({1: 0}),
        Table(),
        {1, 0},
        frozenset({1}),
    ],
)
def test_values_that_are_no_sequence_of_numbers_are_a_type_error(
    area: Area, values: Wrong, memory: holdfast.Memory
) -> None:
    with pytest.raises(TypeError):
        memory.write(area, 0, values)
    assert memory.read(area, 0, 8) == [0] * 8


def test_a_column_with_keys_is_its_values(memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 0, Column([7, 8]))
    assert memory.read("holding_registers", 0, 2) == [7, 8]


@each_register_area
@pytest.mark.parametrize("owner", [b"\x01", (ctypes.c_ubyte * 1)(1)], ids=["bytes", "ctypes"])
def test_a_view_of_bytes_is_no_registers(area: Area, owner: Any, memory: holdfast.Memory) -> None:
    with pytest.raises(TypeError, match="values are memoryview"):
        memory.write(area, 0, memoryview(owner))


@pytest.mark.parametrize("view", [memoryview(b"\x01\0"), memoryview(b"\x01\0").cast("?")])
def test_a_view_of_zeros_and_ones_is_bits(view: Any, memory: holdfast.Memory) -> None:
    memory.write("coils", 0, view)
    assert memory.read("coils", 0, 2) == [1, 0]


@each_area
def test_no_values_are_a_value_error(area: Area, memory: holdfast.Memory) -> None:
    with pytest.raises(ValueError, match="empty"):
        memory.write(area, 0, [])


def test_values_may_come_from_any_iterable(memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 0, (value for value in (1, 2)))
    memory.write("holding_registers", 2, range(3, 5))
    memory.write("holding_registers", 4, (5, 6))

    assert memory.read("holding_registers", 0, 6) == [1, 2, 3, 4, 5, 6]


def test_an_iterable_that_raises_changes_nothing(memory: holdfast.Memory) -> None:
    with pytest.raises(ZeroDivisionError):
        memory.write("holding_registers", 0, (1 // divisor for divisor in (1, 0)))

    assert memory.read("holding_registers", 0, 2) == [0, 0]


def test_an_iterable_may_read_the_memory_that_it_is_written_to(memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 0, [1, 2, 3])

    memory.write(
        "holding_registers",
        0,
        (memory.read("holding_registers", address, 1)[0] + 10 for address in range(3)),
    )

    assert memory.read("holding_registers", 0, 3) == [11, 12, 13]


# Batches


def test_a_batch_writes_several_areas(memory: holdfast.Memory) -> None:
    memory.write_many([("coils", 0, [1]), ("holding_registers", 5, [7, 8])])

    assert memory.read_many([("coils", 0, 2), ("holding_registers", 5, 2)]) == [[1, 0], [7, 8]]


def test_a_later_write_of_a_batch_wins(memory: holdfast.Memory) -> None:
    memory.write_many([("coils", 0, [1, 1, 1]), ("coils", 1, [0])])

    assert memory.read("coils", 0, 3) == [1, 0, 1]


@pytest.mark.parametrize(
    ("bad", "error"),
    [
        (("coils", 0, [2]), ValueError),
        (("coils", 0, []), ValueError),
        (("coils", 0, ["1"]), TypeError),
        (("coils", 1000, [1]), holdfast.OutOfRange),
        (("coils", 999, [1, 1]), holdfast.OutOfRange),
        (("coils", -1, [1]), holdfast.OutOfRange),
        (("relays", 0, [1]), ValueError),
        (("holding_registers", 0, [65536]), ValueError),
    ],
    ids=repr,
)
@pytest.mark.parametrize("place", [0, 50, 100])
def test_a_batch_with_one_bad_write_changes_nothing(
    bad: Wrong, error: type[Exception], place: int, memory: holdfast.Memory
) -> None:
    batch: list[tuple[Area, int, list[int]]] = [
        ("holding_registers", address, [7]) for address in range(100)
    ]
    batch.insert(place, bad)

    with pytest.raises(error):
        memory.write_many(batch)
    assert memory.read("holding_registers", 0, 100) == [0] * 100


def test_a_batch_with_one_bad_range_reads_nothing(memory: holdfast.Memory) -> None:
    with pytest.raises(holdfast.OutOfRange, match="input_registers"):
        memory.read_many([("coils", 0, 1), ("input_registers", 1000, 1)])


def test_an_empty_batch_does_nothing(memory: holdfast.Memory) -> None:
    memory.write_many([])

    assert memory.read_many([]) == []


# The seal


@pytest.fixture(params=BIT_AREAS)
def gate_area(request: pytest.FixtureRequest) -> Area:
    area: Area = request.param
    return area


def test_a_memory_without_a_seal_is_open(memory: holdfast.Memory) -> None:
    assert not memory.sealed


def test_a_memory_with_a_seal_is_sealed_at_first(gate_area: Area) -> None:
    assert holdfast.Memory(coils=10, discrete_inputs=10, seal=(gate_area, 5)).sealed


def test_a_seal_opens_once_and_stays_open(gate_area: Area) -> None:
    memory = holdfast.Memory(coils=10, discrete_inputs=10, seal=(gate_area, 5))
    states = []
    for bits in ([0], [1], [0], [1]):
        memory.write(gate_area, 5, bits)
        states.append(memory.sealed)

    assert states == [True, False, False, False]


def test_a_seal_of_mode_once_is_the_default(gate_area: Area) -> None:
    memory = holdfast.Memory(coils=10, discrete_inputs=10, seal=(gate_area, 5, "once"))
    memory.write(gate_area, 5, [1])
    memory.write(gate_area, 5, [0])

    assert not memory.sealed


def test_a_seal_of_mode_level_follows_its_bit(gate_area: Area) -> None:
    memory = holdfast.Memory(coils=10, discrete_inputs=10, seal=(gate_area, 5, "level"))
    states = []
    for bits in ([0], [1], [1], [0], [1]):
        memory.write(gate_area, 5, bits)
        states.append(memory.sealed)

    assert states == [True, False, False, True, False]


def test_a_seal_opens_when_the_gate_bit_is_one_of_many(gate_area: Area) -> None:
    memory = holdfast.Memory(coils=10, discrete_inputs=10, seal=(gate_area, 5))
    memory.write(gate_area, 0, [0] * 5 + [1] + [0] * 4)

    assert not memory.sealed


def test_neighbours_of_the_gate_bit_do_not_open_the_seal(gate_area: Area) -> None:
    memory = holdfast.Memory(coils=10, discrete_inputs=10, seal=(gate_area, 5))
    memory.write(gate_area, 0, [1] * 5 + [0] + [1] * 4)

    assert memory.sealed


def test_the_seal_is_judged_by_what_the_whole_batch_left() -> None:
    memory = holdfast.Memory(coils=10, seal=("coils", 5))
    memory.write_many([("coils", 5, [1]), ("coils", 5, [0])])

    assert memory.sealed


def test_a_batch_that_is_refused_does_not_open_the_seal() -> None:
    memory = holdfast.Memory(coils=10, seal=("coils", 5))
    with pytest.raises(holdfast.OutOfRange):
        memory.write_many([("coils", 5, [1]), ("coils", 10, [1])])

    assert memory.sealed


def test_python_reads_and_writes_a_sealed_memory() -> None:
    memory = holdfast.Memory(coils=10, holding_registers=10, seal=("coils", 5))
    memory.write("holding_registers", 0, [7])

    assert memory.sealed
    assert memory.read("holding_registers", 0, 1) == [7]


@pytest.mark.parametrize(
    ("seal", "text"),
    [
        (("holding_registers", 5), "coils or discrete_inputs"),
        (("coils", 10), "10"),
        (("coils", 65536), "65536"),
        (("discrete_inputs", 0), "0"),
        (("relays", 5), "relays"),
        (("coils", 5, "twice"), "twice.*once, level"),
    ],
    ids=repr,
)
def test_a_gate_that_can_not_be_is_a_value_error(seal: Wrong, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        holdfast.Memory(coils=10, holding_registers=10, seal=seal)


# Threads


@pytest.fixture
def impatient() -> Iterator[None]:
    """Threads take turns as often as they can."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


class Readers:
    """Threads that read until they are told, and note when all have seen enough changes."""

    CHANGES = 5

    def __init__(self, number: int) -> None:
        self.number = number
        self.enough = threading.Event()
        self.over = threading.Event()
        self._lock = threading.Lock()
        self._to_come = number

    def run(self, look: Callable[[], int]) -> None:
        """Looks again and again; `look` checks what it read and tells its value."""
        changes, last = 0, -1
        while not self.over.is_set():
            value = look()
            if value != last:
                changes, last = changes + 1, value
                if changes == self.CHANGES:
                    self._satisfied()

    def against(self, look: Callable[[], int], *writers: Callable[[], None]) -> None:
        """Runs the readers until all writers have ended."""
        with ThreadPoolExecutor(self.number + len(writers)) as threads:
            readers = [threads.submit(self.run, look) for _ in range(self.number)]
            writing = [threads.submit(writer) for writer in writers]
            try:
                for writer in writing:
                    writer.result()
            finally:
                self.over.set()
            for reader in readers:
                reader.result()

    def _satisfied(self) -> None:
        with self._lock:
            self._to_come -= 1
            if self._to_come == 0:
                self.enough.set()


@pytest.mark.usefixtures("impatient")
def test_no_reader_sees_a_part_of_a_batch(memory: holdfast.Memory) -> None:
    readers = Readers(3)

    def write(value: int) -> None:
        for turn in rounds(readers.enough, least=300):
            number = value * 10_000 + turn % 10_000
            bit = number % 2
            memory.write_many(
                [
                    ("holding_registers", 0, [number] * 1000),
                    ("input_registers", 0, [number] * 1000),
                    ("coils", 0, [bit] * 1000),
                    ("discrete_inputs", 0, [bit] * 1000),
                ]
            )

    def look() -> int:
        ranges: list[tuple[Area, int, int]] = [(area, 0, 1000) for area in AREAS]
        coils, discrete, holding, inputs = memory.read_many(ranges)
        assert len({*holding, *inputs}) == 1
        assert {*coils, *discrete} == {holding[0] % 2}
        return holding[0]

    readers.against(look, *[partial(write, value) for value in (1, 2, 3)])


@pytest.mark.usefixtures("impatient")
def test_no_reader_sees_a_part_of_one_large_write() -> None:
    memory = holdfast.Memory(holding_registers=65536)
    readers = Readers(2)

    def write() -> None:
        for turn in rounds(readers.enough, least=50):
            memory.write("holding_registers", 0, [turn & 0xFFFF] * 65536)

    def look() -> int:
        first, last = memory.read_many(
            [("holding_registers", 0, 10), ("holding_registers", 65526, 10)]
        )
        assert len({*first, *last}) == 1
        return first[0]

    readers.against(look, write)
