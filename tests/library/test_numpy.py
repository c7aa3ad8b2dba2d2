"""NumPy's integers and booleans are accepted wherever Python's are, and its floats are refused."""

from __future__ import annotations

import importlib
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import raw_ingest, values
from holdfast._core import Batch
from holdfast.tags import TagError
from holdfast.values import DoesNotFit, Field, Layout
from support.brokers import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator

numpy: Any = importlib.import_module("numpy")
TWO = numpy.int64(2)
SMALL = numpy.uint8(3)
YES, NO = numpy.bool_(True), numpy.bool_(False)
FLOAT = numpy.float64(1.0)

pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture
def memory() -> holdfast.Memory:
    return holdfast.Memory(
        coils=numpy.uint16(100), holding_registers=(numpy.int32(0), numpy.int32(65536))
    )


@pytest.fixture
def server(memory: holdfast.Memory) -> Iterator[holdfast.Server]:
    one = numpy.uint8(1)
    with holdfast.Server(
        {one: memory},
        bind="127.0.0.1:0",
        access="read-write",
        deny=[numpy.int16(8)],
        max_connections=numpy.int64(8),
        workers=one,
        idle_timeout=numpy.float32(300),
    ) as started:
        yield started


@pytest.fixture
def plc(server: holdfast.Server) -> Iterator[holdfast.SyncClient]:
    url = f"tcp://127.0.0.1:{server.address[1]}"
    with holdfast.SyncClient(url, unit=numpy.int64(1), timeout=numpy.float64(10)) as client:
        yield client


def test_a_memory_takes_them(memory: holdfast.Memory) -> None:
    memory.write("holding_registers", TWO, numpy.array([1, 65535], "u2"))
    assert memory.read("holding_registers", TWO, TWO) == [1, 65535]
    memory.write_many([("coils", SMALL, [YES, NO, numpy.uint64(1)]), ("coils", 9, [TWO - 1])])
    assert memory.read_many([("coils", SMALL, SMALL), ("coils", 9, 1)]) == [[1, 0, 1], [1]]
    assert Batch([(memory, "coils", TWO, numpy.array([True, False]))]).write() == (2, None)
    assert memory.read("coils", 2, 2) == [1, 0]


@pytest.mark.parametrize("wrong", [FLOAT, numpy.float32(1), numpy.str_("1"), None])
def test_a_memory_refuses_other_types(memory: holdfast.Memory, wrong: Any) -> None:
    for area in ("coils", "holding_registers"):
        with pytest.raises(TypeError, match=r"values\[0\] is"):
            memory.write(area, 0, [wrong])
    with pytest.raises(TypeError):
        memory.write("coils", wrong, [1])


@pytest.mark.parametrize("wrong", [True, YES])
def test_a_boolean_is_no_register(memory: holdfast.Memory, wrong: Any) -> None:
    with pytest.raises(TypeError, match="integers 0 to 65535"):
        memory.write("holding_registers", 0, [wrong])
    with pytest.raises(TypeError, match="integers 0 to 65535"):
        raw_ingest.encode("holding_registers", 0, [wrong], unit=1)


def test_an_integer_out_of_range_is_refused(memory: holdfast.Memory) -> None:
    with pytest.raises(ValueError, match="65536"):
        memory.write("holding_registers", 0, [numpy.int32(65536)])
    with pytest.raises(ValueError, match="-1"):
        memory.write("holding_registers", 0, [numpy.int8(-1)])


def test_a_client_takes_them(plc: holdfast.SyncClient, memory: holdfast.Memory) -> None:
    plc.write_coil(TWO, YES)
    plc.write_coils(SMALL, numpy.array([True, False, True]))
    assert plc.read_coils(TWO, numpy.int16(4)) == [True, True, False, True]
    plc.write_register(TWO, SMALL)
    plc.write_registers(SMALL, numpy.array([7, 8], "u2"))
    assert plc.read_holding_registers(TWO, SMALL) == [3, 7, 8]
    plc.mask_write(TWO, and_mask=numpy.uint16(0), or_mask=numpy.uint16(9))
    assert plc.read_write(TWO, TWO, SMALL, [numpy.uint16(1)], unit=numpy.uint8(1)) == [9, 1]
    plc.write("holding_registers", TWO, YES, "bit:4")
    assert memory.read("holding_registers", 2, 1) == [9 | 16]
    plc.write("coils", TWO, NO, "bool")
    assert plc.read("coils", TWO, "bool") is False
    with pytest.raises(TypeError, match="integers 0 to 65535"):
        plc.write_register(0, FLOAT)
    with pytest.raises(ValueError, match="unit is"):
        plc.read_coils(0, 1, unit=FLOAT)
    with pytest.raises(ValueError, match="unit is"):
        plc.read_coils(0, 1, unit=YES)


def test_small_integers_do_not_wrap(plc: holdfast.SyncClient) -> None:
    count = numpy.uint8(200)
    assert plc.read_holding_registers(numpy.uint8(100), count) == [0] * 200
    words = numpy.arange(1000, dtype="u2")
    plc.write_registers(numpy.uint16(65000 - 465), words, split=True)
    assert plc.read_holding_registers(64535, 1000) == words.tolist()
    assert plc.read("holding_registers", numpy.uint8(250), "uint16[200]") == [0] * 200


def test_diagnostics_take_them(plc: holdfast.SyncClient) -> None:
    with pytest.raises(holdfast.ModbusException):
        plc.diagnostics(numpy.uint16(0), [numpy.uint16(5)])
    with pytest.raises(TypeError, match=r"data\[0\] is"):
        plc.diagnostics(0, [FLOAT])


async def read_a_coil(url: str) -> list[bool]:
    async with holdfast.Client(url, unit=numpy.int64(1), max_in_flight=TWO, timeout=10) as plc:
        return await plc.read_coils(TWO, TWO)


def test_the_asynchronous_client_takes_them(server: holdfast.Server) -> None:
    import asyncio

    assert asyncio.run(read_a_coil(f"tcp://127.0.0.1:{server.address[1]}")) == [False, False]


@pytest.mark.parametrize(
    ("value", "kind", "registers"),
    [
        (YES, "bool", [1]),
        (numpy.uint8(0), "bool", [0]),
        (YES, "bit:3", [8]),
        (numpy.int8(-1), "int32", [65535, 65535]),
        (numpy.uint8(12), "bcd16", [0x12]),
        (numpy.float32(1.5), "float32", [0x3FC0, 0]),
        (numpy.int64(2**60 + 2**36 + 1), "float32", [0x5D80, 1]),
        (numpy.array([True, False]), "bool[2]", [1, 0]),
        (numpy.array([1, 2], "i8"), "uint16[2]", [1, 2]),
    ],
)
def test_values_are_encoded(value: Any, kind: str, registers: list[int]) -> None:
    assert values.encode(value, kind) == registers


@pytest.mark.parametrize(
    ("value", "kind"),
    [(FLOAT, "int16"), (FLOAT, "bool"), (FLOAT, "bcd16"), (YES, "uint16"), (YES, "float32")],
)
def test_values_of_another_type_are_refused(value: Any, kind: str) -> None:
    with pytest.raises(DoesNotFit):
        values.encode(value, kind)


@pytest.mark.parametrize(
    ("value", "found"),
    [(numpy.int64(2**62 + 1), "4611686018427387905"), (numpy.float64(1e6), "1000000.0")],
)
def test_a_number_that_is_refused_is_shown_as_it_was_given(value: Any, found: str) -> None:
    with pytest.raises(DoesNotFit, match=f"^{found} is outside"):
        values.encode(value, "float16")


def test_a_finite_number_too_large_for_a_float_is_refused() -> None:
    large = numpy.finfo(numpy.longdouble).max
    # Where numpy has no floats with more bits, float32 is too small all the same.
    kind = "float32" if large == numpy.finfo(numpy.float64).max else "float64"
    for value, wanted in [(large, kind), ([1.0, -large], f"{kind}[2]")]:
        with pytest.raises(DoesNotFit, match="is outside"):
            values.encode(value, wanted)
    assert values.encode(numpy.longdouble("inf"), "float64") == [0x7FF0, 0, 0, 0]


def test_values_are_decoded() -> None:
    assert values.decode([numpy.uint16(1), numpy.int64(2)], "uint32") == 65538
    assert values.decode([YES, False], "bool[2]") == [True, False]
    with pytest.raises(values.InvalidRegister):
        values.decode([YES], "uint16")


def test_layouts_and_tags_take_them() -> None:
    layout = Layout([Field("a", "uint16", TWO)], size=numpy.uint8(4))
    assert layout.decode([0, 0, 7, 0]) == {"a": 7}
    tag = holdfast.Tag("a", "holding_registers", numpy.uint16(65535), scale=0.5)
    assert (type(tag.address), tag.raw(numpy.float32(1.5)), tag.raw(TWO)) == (int, 3, 4)
    for wrong in (FLOAT, YES):
        with pytest.raises(TagError, match="address is"):
            holdfast.Tag("a", "holding_registers", wrong)
        with pytest.raises(values.InvalidLayout):
            Layout([("a", "uint16", wrong)])


def test_the_numbers_of_a_tag_are_plain() -> None:
    tag = holdfast.Tag(
        "a",
        "holding_registers",
        0,
        "uint64",
        scale=numpy.int16(100),
        offset=numpy.int8(-100),
        min=numpy.uint8(0),
        max=numpy.float64(1e9),
        deadband=numpy.float64(0.5),
        states={numpy.int64(0): "off", YES * TWO * 100: "on"},
        null=frozenset([numpy.uint16(65535)]),
    )
    numbers = [tag.scale, tag.offset, tag.min, tag.max, tag.deadband, *tag.states, *tag.null]
    assert numbers == [100, -100, 0, 1e9, 0.5, 0, 200, 65535]
    assert [type(number) for number in numbers] == [int, int, int, float, float, int, int, int]
    large = tag.value(2**63)
    assert (type(large), large, tag.value(65535)) == (int, 100 * 2**63 - 100, None)
    assert tag.raw(numpy.uint8(200)) == 3
    assert holdfast.Tag("b", "holding_registers", 0, scale=numpy.float64(0.1)).value(215) == 21.5
    switch = holdfast.Tag("c", "coils", 0, states={NO: "off", YES: "on"})
    assert [(type(number), number) for number in switch.states] == [(int, 0), (int, 1)]


@pytest.mark.parametrize(
    "wrong", [numpy.float32(0.1), numpy.float16(1), YES, numpy.float64("nan"), numpy.str_("1")]
)
def test_other_numbers_of_a_tag_are_refused(wrong: Any) -> None:
    for key in ("scale", "offset", "min", "max", "deadband"):
        with pytest.raises(TagError, match=f"^{key} is .*, allowed: a finite number, int or flo"):
            holdfast.Tag("a", "holding_registers", 0, **{key: wrong})


def test_raw_ingest_takes_them() -> None:
    assert raw_ingest.encode(
        "holding_registers", TWO, numpy.array([5, 6], "u2"), unit=SMALL
    ) == raw_ingest.encode("holding_registers", 2, [5, 6], unit=3)
    assert raw_ingest.encode("coils", 0, [YES, NO], unit=1) == raw_ingest.encode(
        "coils", 0, [True, False], unit=1
    )
    with pytest.raises(TypeError, match="address is"):
        raw_ingest.encode("coils", FLOAT, [1], unit=1)
    with pytest.raises(raw_ingest.RawError, match="nothing was written"):
        raw_ingest.send_sync("127.0.0.1", numpy.int64(free_port()), "coils", 0, [1], unit=1)


def test_numpy_is_not_imported() -> None:
    code = "import sys, holdfast; holdfast.Memory(coils=8).write('coils', 0, [True]); "
    code += "sys.exit('numpy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
