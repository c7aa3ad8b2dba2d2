"""The client against servers of others: pymodbus on every transport, and libmodbus.

What one of them does not know, or answers in its own way, is said where it differs.
"""

from __future__ import annotations

import asyncio
import shlex
import subprocess
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from pymodbus import FramerType
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusUdpServer
from pymodbus.simulator import DataType, SimData, SimDevice

import holdfast
import wire
from conftest import missing, tool
from faces import FACES, Dial, Face, dialling
from lines import Cable

if TYPE_CHECKING:
    from collections.abc import Awaitable, Iterator

Identity: Any = ModbusDeviceIdentification
LONG = {"ModelName": "m" * 200, "UserApplicationName": "u" * 200}
"""Two objects of which a reply holds one."""

FRAMERS = {
    "tcp": FramerType.SOCKET,
    "rtu+tcp": FramerType.RTU,
    "udp": FramerType.SOCKET,
    "rtu": FramerType.RTU,
    "ascii": FramerType.ASCII,
}


class Pymodbus:
    """One of pymodbus's servers, in a thread of its own; unit 1 has 1000 items in every area."""

    def __init__(self, kind: str, cable: Cable | None = None) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self._server: Any = self._run(self._started(kind, cable))
        if cable is not None:
            self.url = f"{kind}://{cable.devices[1]}?parity=none"
        else:
            transport = self._server.transport
            own = transport.sockets[0] if kind != "udp" else transport.get_extra_info("socket")
            self.url = f"{kind}://127.0.0.1:{own.getsockname()[1]}"

    def stop(self) -> None:
        self._run(self._server.shutdown())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _started(self, kind: str, cable: Cable | None) -> Any:
        names = {"VendorName": "Acme", "ProductCode": "P1", "MajorMinorRevision": "1.2", **LONG}
        options: dict[str, Any] = {
            "framer": FRAMERS[kind],
            "identity": Identity(info_name=names),
        }
        server: Any
        if cable is not None:
            server = ModbusSerialServer(unit_1(), port=str(cable.devices[0]), **options)
        else:
            make = ModbusUdpServer if kind == "udp" else ModbusTcpServer
            server = make(unit_1(), address=("127.0.0.1", 0), **options)
        await server.serve_forever(background=True)
        return server

    def _run(self, awaitable: Awaitable[Any]) -> Any:
        async def awaited() -> Any:
            return await awaitable

        return asyncio.run_coroutine_threadsafe(awaited(), self._loop).result(wire.DEADLINE)


def unit_1() -> SimDevice:
    def bits(values: list[bool]) -> list[SimData]:
        return [SimData(0, values=values, datatype=DataType.BITS)]

    def registers(values: list[int]) -> list[SimData]:
        return [SimData(0, values=values, datatype=DataType.REGISTERS)]

    inputs = bits([at % 3 == 0 for at in range(1000)]), registers(list(range(1000)))
    return SimDevice(
        id=1, simdata=(bits([False] * 1000), inputs[0], registers([0] * 1000), inputs[1])
    )


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


def tour(client: Face) -> None:
    """Whatever reads and writes, and an exception."""
    assert client.read_input_registers(5, 125) == list(range(5, 130))
    assert client.read_input_registers(0, 1000) == list(range(1000))
    assert client.read_discrete_inputs(3, 4) == [True, False, False, True]
    assert client.read_discrete_inputs(0, 999) == [True, False, False] * 333

    client.write_coil(2, True)
    client.write_coils(3, [True, False, True])
    assert client.read_coils(1, 6) == [False, True, True, False, True, False]
    client.write_coil(2, False)
    assert client.read("coils", 2, "bool") is False

    client.write_register(3, 4711)
    client.write_registers(0, [1, 2, 3])
    assert client.read_holding_registers(0, 5) == [1, 2, 3, 4711, 0]
    client.mask_write(0, and_mask=0xF2, or_mask=0x25)
    assert client.read_holding_registers(0, 1) == [(1 & 0xF2) | (0x25 & ~0xF2)]
    assert client.read_write(0, 4, 1, [70, 80]) == [5, 70, 80, 4711]
    client.write_registers(100, range(300), split=True)
    assert client.read_holding_registers(100, 300) == list(range(300))
    client.write("holding_registers", 10, -21.5, "float32", "CDAB")
    assert client.read("holding_registers", 10, "float32", "CDAB") == -21.5
    client.write("holding_registers", 12, True, "bit:9")
    assert client.read_holding_registers(12, 1) == [1 << 9]

    with pytest.raises(holdfast.ModbusException) as caught:
        client.read_holding_registers(1000, 1)
    assert (caught.value.code, caught.value.name) == (2, "Illegal Data Address")
    with pytest.raises(holdfast.ModbusException) as caught:
        client.write_registers(999, [1, 2])
    assert caught.value.code == 2


# pymodbus


@pytest.fixture(params=FRAMERS)
def pymodbus(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Pymodbus]:
    with ExitStack() as stack:
        line = request.param in ("rtu", "ascii")
        server = Pymodbus(request.param, stack.enter_context(Cable(tmp_path)) if line else None)
        stack.callback(server.stop)
        yield server


def test_pymodbus_is_asked_everything(pymodbus: Pymodbus, dial: Dial) -> None:
    client = dial(pymodbus.url)

    tour(client)

    who = client.identify()
    assert (who.vendor_name, who.product_code, who.revision) == ("Acme", "P1", "1.2")
    assert (who.model_name, who.user_application_name) == tuple(LONG.values())
    assert client.report_server_id().data == b"Acme-P1-1.2\xff"
    assert client.diagnostics(0, [0x1234]) == [0x1234]
    assert len(client.diagnostics(11)) == 1
    assert client.event_counter()[0] is False


def test_pymodbus_answers_several_tasks_one_after_the_other() -> None:
    server = Pymodbus("tcp")

    async def main() -> None:
        # Of requests that come together it answers only one.
        async with holdfast.Client(server.url, timeout=wire.DEADLINE, max_in_flight=1) as plc:
            calls = [plc.read_input_registers(at, 1) for at in range(100)]
            assert await asyncio.gather(*calls) == [[at] for at in range(100)]

    try:
        asyncio.run(main(), debug=True)
    finally:
        server.stop()


# libmodbus


@pytest.fixture(scope="module")
def libmodbus_server(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The server, compiled."""
    flags = subprocess.run(
        [tool("pkg-config"), "--cflags", "--libs", "libmodbus"],
        capture_output=True,
        text=True,
        check=False,
    )
    if flags.returncode != 0:
        missing("libmodbus with its headers")
    program = tmp_path_factory.mktemp("libmodbus") / "server"
    source = Path(__file__).with_name("libmodbus_server.c")
    subprocess.run(
        [tool("cc"), "-Wall", "-o", program, source, *shlex.split(flags.stdout)], check=True
    )
    return program


@pytest.fixture(params=["tcp", "rtu"])
def libmodbus(
    request: pytest.FixtureRequest, libmodbus_server: Path, tmp_path: Path
) -> Iterator[str]:
    """The URL of a libmodbus server."""
    kind = request.param
    with ExitStack() as stack:
        cable = stack.enter_context(Cable(tmp_path)) if kind == "rtu" else None
        words = [kind, *([] if cable is None else [str(cable.devices[0])])]
        server = stack.enter_context(
            subprocess.Popen([libmodbus_server, *words], stdout=subprocess.PIPE, text=True)
        )
        stack.callback(server.kill)
        assert server.stdout is not None
        port = int(server.stdout.readline())
        yield (
            f"tcp://127.0.0.1:{port}" if cable is None else f"rtu://{cable.devices[1]}?parity=none"
        )


def test_libmodbus_is_asked_everything(libmodbus: str, dial: Dial) -> None:
    client = dial(libmodbus)

    tour(client)

    answer = client.report_server_id()
    assert answer.running is True
    assert answer.additional.startswith(b"LMB")
    if libmodbus.startswith("tcp"):
        # On a line it does not answer what it does not know.
        with pytest.raises(holdfast.ModbusException, match="Illegal Function"):
            client.identify()


@pytest.mark.parametrize("libmodbus", ["tcp"], indirect=True)
def test_libmodbus_answers_many_requests_in_flight(libmodbus: str) -> None:
    async def main() -> None:
        async with holdfast.Client(libmodbus, timeout=wire.DEADLINE) as plc:
            calls = [plc.read_input_registers(at, 1) for at in range(500)]
            assert await asyncio.gather(*calls) == [[at] for at in range(500)]

    asyncio.run(main(), debug=True)
