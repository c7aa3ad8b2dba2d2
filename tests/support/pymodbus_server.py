"""pymodbus as a server: one unit with all areas, and a tour of a client's functions."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal

import pytest
from pymodbus import FramerType
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusUdpServer
from pymodbus.simulator import DataType, SimData, SimDevice

import holdfast
from support import wire
from support.faces import Face
from support.lines import Cable

Identity: Any = ModbusDeviceIdentification

LONG = {"ModelName": "m" * 200, "UserApplicationName": "u" * 200}
"""Two objects that do not fit into one reply."""

PastEnd = Literal["exception", "fewer values", "all addresses"]

FRAMERS = {
    "tcp": FramerType.SOCKET,
    "rtu+tcp": FramerType.RTU,
    "udp": FramerType.SOCKET,
    "rtu": FramerType.RTU,
    "ascii": FramerType.ASCII,
}


class Pymodbus:
    """A pymodbus server in its own thread; unit 1 has 1000 items in every area."""

    def __init__(self, kind: str, cable: Cable | None = None) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self._server: Any = self._run(self._started(kind, cable))
        if cable is not None:
            self.url = f"{kind}://{cable.devices[1]}?parity=none&baud=4000000"
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


def tour(
    client: Face,
    lacks: Mapping[int, int | None] = MappingProxyType({}),
    *,
    past_end: PastEnd = "exception",
    max_written: int = 123,
) -> None:
    """Calls every function that reads or writes, and provokes an exception.

    `lacks` has functions that the server lacks, with the exception code of its reply, or nothing if
    it does not reply. `past_end` says what it answers past its last address: exception 02, fewer
    values, or it has all addresses. It accepts up to `max_written` registers in a request.
    """
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
    if 22 not in lacks:
        client.mask_write(0, and_mask=0xF2, or_mask=0x25)
        assert client.read_holding_registers(0, 1) == [(1 & 0xF2) | (0x25 & ~0xF2)]
    elif lacks[22] is not None:
        _refused(lacks[22], lambda: client.mask_write(0, and_mask=0xF2, or_mask=0x25))
    if 23 not in lacks:
        before = client.read_holding_registers(0, 1)
        assert client.read_write(0, 4, 1, [70, 80]) == [*before, 70, 80, 4711]
    elif lacks[23] is not None:
        _refused(lacks[23], lambda: client.read_write(0, 4, 1, [70, 80]))
    if max_written == 123:
        client.write_registers(100, range(300), split=True)
    else:
        for at in range(0, 300, max_written):
            client.write_registers(100 + at, range(at, min(at + max_written, 300)))
    assert client.read_holding_registers(100, 300) == list(range(300))
    client.write("holding_registers", 10, -21.5, "float32", "CDAB")
    assert client.read("holding_registers", 10, "float32", "CDAB") == -21.5
    if 22 not in lacks:
        client.write("holding_registers", 12, True, "bit:9")
        assert client.read_holding_registers(12, 1) == [1 << 9]

    if past_end == "exception":
        _refused(2, lambda: client.read_holding_registers(1000, 1))
        _refused(2, lambda: client.write_registers(999, [1, 2]))
    elif past_end == "fewer values":
        with pytest.raises(holdfast.InvalidResponse, match="does not match the request"):
            client.read_holding_registers(1000, 1)


def _refused(code: int, call: Callable[[], object]) -> None:
    with pytest.raises(holdfast.ModbusException) as caught:
        call()
    names = {1: "Illegal Function", 2: "Illegal Data Address"}
    assert (caught.value.code, caught.value.name) == (code, names[code])


# pymodbus
