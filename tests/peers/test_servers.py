"""Real clients of others: `mbpoll` (libmodbus) and pymodbus, synchronous and asyncio.

What they wrote is looked up in memory, what they read was put there. Each test runs twice: against
a Modbus TCP server, and through a route to an RTU server with the same memory.
"""

from __future__ import annotations

import re
import subprocess
from typing import TYPE_CHECKING, Any

import pytest
from pymodbus.client import AsyncModbusTcpClient, ModbusTcpClient

from holdfast.server import Identity
from support import routed
from support.machine import tool
from support.pymodbus_peer import OPTIONS, Patient, connected

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import holdfast
    from holdfast.types import Area
    from support.running import Serve

BITS = [1, 0, 1, 1, 0, 0, 1, 1, 1, 0, 1]
REGISTERS = [0, 1, 255, 256, 32767, 32768, 65535]


IDENTITY = Identity(vendor_name="Acme", product_code="P1", revision="1.2", product_name="Pump")


@pytest.fixture(params=["direct", "route"])
def address(
    request: pytest.FixtureRequest, memory: holdfast.Memory, serve: Serve, tmp_path: Path
) -> Iterator[tuple[str, int]]:
    """Where clients reach the memory as unit 1."""
    if request.param == "direct":
        yield serve({1: memory}, identity=IDENTITY).address
    else:
        with routed.to_rtu_server(memory, IDENTITY, tmp_path) as at:
            yield at


# mbpoll

COIL, DISCRETE_INPUT, INPUT_REGISTER, HOLDING_REGISTER = "0", "1", "3", "4"


class Mbpoll:
    """Runs mbpoll against a server. Its references count from 1."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._program = tool("mbpoll")
        self._host, self._port = address

    def _run(self, kind: str, reference: int, unit: int, *more: str) -> str:
        server = ["-m", "tcp", "-p", str(self._port), "-a", str(unit)]
        ran = subprocess.run(
            [self._program, *server, "-t", kind, "-r", str(reference), "-q", *more],
            capture_output=True,
            text=True,
            timeout=20,
            check=False,
        )
        return ran.stdout + ran.stderr

    def ask(self, kind: str, reference: int, count: int = 1, unit: int = 1) -> str:
        """Reads once; what mbpoll prints."""
        return self._run(kind, reference, unit, "-c", str(count), "-1", self._host)

    def write(self, kind: str, reference: int, values: list[int]) -> str:
        """Writes; what mbpoll prints."""
        return self._run(kind, reference, 1, self._host, "--", *map(str, values))

    def read(self, kind: str, reference: int, count: int) -> list[int]:
        output = self.ask(kind, reference, count)
        values = re.findall(r"^\[(\d+)\]:\s+(\d+)", output, re.MULTILINE)
        assert [int(at) for at, _ in values] == list(range(reference, reference + count)), output
        return [int(value) for _, value in values]


@pytest.fixture
def mbpoll(address: tuple[str, int]) -> Mbpoll:
    return Mbpoll(address)


@pytest.mark.parametrize(
    ("kind", "area", "values"),
    [
        (COIL, "coils", BITS),
        (DISCRETE_INPUT, "discrete_inputs", BITS),
        (INPUT_REGISTER, "input_registers", REGISTERS),
        (HOLDING_REGISTER, "holding_registers", REGISTERS),
    ],
    ids=["coils", "discrete inputs", "input registers", "holding registers"],
)
def test_mbpoll_reads_every_area(
    kind: str, area: Area, values: list[int], memory: holdfast.Memory, mbpoll: Mbpoll
) -> None:
    memory.write(area, 100, values)

    assert mbpoll.read(kind, 100, len(values) + 2) == [0, *values, 0]


@pytest.mark.parametrize(
    ("kind", "area", "values"),
    [
        (COIL, "coils", [1]),
        (COIL, "coils", BITS),
        (HOLDING_REGISTER, "holding_registers", [4711]),
        (HOLDING_REGISTER, "holding_registers", REGISTERS),
    ],
    ids=["one coil", "coils", "one register", "registers"],
)
def test_mbpoll_writes_what_can_be_written(
    kind: str, area: Area, values: list[int], memory: holdfast.Memory, mbpoll: Mbpoll
) -> None:
    output = mbpoll.write(kind, 51, values)

    assert f"Written {len(values)} reference" in output, output
    assert memory.read(area, 49, len(values) + 2) == [0, *values, 0]


def test_mbpoll_is_told_of_an_illegal_address(mbpoll: Mbpoll) -> None:
    assert "Illegal data address" in mbpoll.ask(HOLDING_REGISTER, 1001)


def test_mbpoll_is_told_that_a_unit_does_not_respond(mbpoll: Mbpoll) -> None:
    assert "Target device failed to respond" in mbpoll.ask(HOLDING_REGISTER, 1, unit=9)


# pymodbus


@pytest.fixture(params=["sync", "asyncio"])
def pymodbus(request: pytest.FixtureRequest, address: tuple[str, int]) -> Iterator[Any]:
    host, port = address
    if request.param == "sync":
        with connected(ModbusTcpClient(host, port=port, **OPTIONS)) as client:
            yield client
    else:
        with patient(address) as client:
            yield client


def patient(address: tuple[str, int]) -> Patient:
    host, port = address
    return Patient(lambda: AsyncModbusTcpClient(host, port=port, **OPTIONS))


@pytest.mark.parametrize(
    ("method", "area"), [("read_coils", "coils"), ("read_discrete_inputs", "discrete_inputs")]
)
def test_pymodbus_reads_bits(
    method: str, area: Area, memory: holdfast.Memory, pymodbus: Any
) -> None:
    memory.write(area, 100, BITS)

    reply = getattr(pymodbus, method)(99, count=len(BITS) + 2)

    assert [int(bit) for bit in reply.bits[: len(BITS) + 2]] == [0, *BITS, 0]
    assert not any(reply.bits[len(BITS) + 2 :])


@pytest.mark.parametrize(
    ("method", "area"),
    [
        ("read_holding_registers", "holding_registers"),
        ("read_input_registers", "input_registers"),
    ],
)
def test_pymodbus_reads_registers(
    method: str, area: Area, memory: holdfast.Memory, pymodbus: Any
) -> None:
    memory.write(area, 100, REGISTERS)

    reply = getattr(pymodbus, method)(99, count=len(REGISTERS) + 2)

    assert reply.registers == [0, *REGISTERS, 0]


def test_pymodbus_reads_the_most_registers(memory: holdfast.Memory, pymodbus: Any) -> None:
    memory.write("holding_registers", 0, range(125))

    assert pymodbus.read_holding_registers(0, count=125).registers == list(range(125))


def test_pymodbus_writes_a_coil(memory: holdfast.Memory, pymodbus: Any) -> None:
    assert not pymodbus.write_coil(7, True).isError()
    assert memory.read("coils", 6, 3) == [0, 1, 0]
    assert not pymodbus.write_coil(7, False).isError()
    assert memory.read("coils", 6, 3) == [0, 0, 0]


def test_pymodbus_writes_coils(memory: holdfast.Memory, pymodbus: Any) -> None:
    assert not pymodbus.write_coils(7, [bool(bit) for bit in BITS]).isError()
    assert memory.read("coils", 6, len(BITS) + 2) == [0, *BITS, 0]


def test_pymodbus_writes_a_register(memory: holdfast.Memory, pymodbus: Any) -> None:
    assert not pymodbus.write_register(7, 4711).isError()
    assert memory.read("holding_registers", 6, 3) == [0, 4711, 0]


def test_pymodbus_writes_registers(memory: holdfast.Memory, pymodbus: Any) -> None:
    assert not pymodbus.write_registers(7, REGISTERS).isError()
    assert memory.read("holding_registers", 6, len(REGISTERS) + 2) == [0, *REGISTERS, 0]


def test_pymodbus_masks_a_register(memory: holdfast.Memory, pymodbus: Any) -> None:
    memory.write("holding_registers", 4, [0x12])

    assert not pymodbus.mask_write_register(address=4, and_mask=0xF2, or_mask=0x25).isError()
    assert memory.read("holding_registers", 4, 1) == [0x17]


def test_pymodbus_writes_and_reads_registers_in_one_step(
    memory: holdfast.Memory, pymodbus: Any
) -> None:
    memory.write("holding_registers", 0, [1, 2, 3, 4])

    reply = pymodbus.readwrite_registers(
        read_address=0, read_count=4, write_address=1, values=[70, 80]
    )

    assert reply.registers == [1, 70, 80, 4]
    assert memory.read("holding_registers", 0, 4) == [1, 70, 80, 4]


def test_pymodbus_gets_its_query_data_back(pymodbus: Any) -> None:
    reply = pymodbus.diag_query_data(b"\x12\x34")

    assert not reply.isError()
    assert reply.message == b"\x12\x34"


def test_pymodbus_reads_the_identification(pymodbus: Any) -> None:
    basic = pymodbus.read_device_information(read_code=1)
    regular = pymodbus.read_device_information(read_code=2)
    single = pymodbus.read_device_information(read_code=4, object_id=4)

    assert basic.information == {0: b"Acme", 1: b"P1", 2: b"1.2"}
    assert regular.information == {0: b"Acme", 1: b"P1", 2: b"1.2", 4: b"Pump"}
    assert single.information == {4: b"Pump"}
    assert basic.conformity == 0x83


def test_pymodbus_reads_the_server_id(pymodbus: Any) -> None:
    reply = pymodbus.report_device_id()

    assert not reply.isError()
    assert b"Acme" in reply.identifier


def test_pymodbus_reads_the_event_counter(pymodbus: Any) -> None:
    before = pymodbus.diag_get_comm_event_counter()
    pymodbus.read_coils(0)
    after = pymodbus.diag_get_comm_event_counter()

    assert not before.isError()
    assert after.count == before.count + 1


@pytest.mark.parametrize(
    ("call", "code"),
    [
        (lambda client: client.read_coils(1000), 2),
        (lambda client: client.read_holding_registers(999, count=2), 2),
        (lambda client: client.read_coils(0, device_id=9), 11),
        (lambda client: client.read_fifo_queue(address=0), 1),
    ],
    ids=["address", "last and one more", "unit", "function"],
)
def test_pymodbus_is_told_of_an_exception(
    call: Callable[[Any], Any],
    code: int,
    pymodbus: Any,
) -> None:
    reply = call(pymodbus)

    assert reply.isError()
    assert reply.exception_code == code


def test_pymodbus_may_have_many_requests_on_their_way(
    memory: holdfast.Memory, address: tuple[str, int]
) -> None:
    memory.write("holding_registers", 0, range(1000))

    with patient(address) as client:
        replies = client.many("read_holding_registers", range(200))

    assert [reply.registers for reply in replies] == [[value] for value in range(200)]
