"""The simulators that the reference of Port of Call starts for local tests, asked by the gateway.

Its program is executed as printed, by a version of pymodbus that has its names: later ones have
others. Its container starts a server of the same package: here as a program, with the contents and
the port of that container. Requests and command lines of the reference are in `tests/gateway`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.gateway.pool import Pool
from support import gateways
from support.fake_device import FakeDevice
from support.machine import tool
from support.peer_programs import DRIVERS, built, made

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import holdfast

REQUIREMENTS = DRIVERS / "pymodbus-3.8.6.txt"

PRINTED = """
from pymodbus.server import StartTcpServer
from pymodbus.datastore import ModbusSlaveContext, ModbusServerContext, ModbusSequentialDataBlock
store = ModbusSlaveContext(
  di=ModbusSequentialDataBlock(0, [0]*100),
  co=ModbusSequentialDataBlock(0, [0]*100),
  hr=ModbusSequentialDataBlock(0, list(range(100))),
  ir=ModbusSequentialDataBlock(0, list(range(100))),
)
StartTcpServer(ModbusServerContext(store, single=True), address=('0.0.0.0', 502))
"""

CONTAINER = """
from pymodbus.server import StartTcpServer
from pymodbus.datastore import ModbusSlaveContext, ModbusServerContext, ModbusSequentialDataBlock
blocks = {area: ModbusSequentialDataBlock.create() for area in ("di", "co", "hr", "ir")}
StartTcpServer(
    ModbusServerContext(slaves=ModbusSlaveContext(**blocks), single=True), address=("0.0.0.0", 5020)
)
"""
"""It listens on 5020: the reference publishes 502, where the container has nothing."""

ON_LOOPBACK = """
import asyncio, sys
from asyncio.base_events import BaseEventLoop
create_server = BaseEventLoop.create_server

async def on_loopback(self, factory, host, port, **options):
    assert host == "0.0.0.0" and port in (502, 5020)
    server = await create_server(self, factory, "127.0.0.1", 0, **options)
    print(server.sockets[0].getsockname()[1], flush=True)
    return server

BaseEventLoop.create_server = on_loopback
exec(sys.argv[1])
"""
"""Runs a program whose server listens on a free port of this machine in place of its own."""


def pymodbus() -> Path:
    """The folder with the version of pymodbus."""

    def install(folder: Path) -> None:
        options = ["--quiet", "--no-deps", "--only-binary=:all:", "--require-hashes"]
        where = ["--target", str(folder), "-r", str(REQUIREMENTS)]
        built([sys.executable, "-m", "pip", "install", *options, *where], folder)

    return made("pymodbus-3.8.6", [REQUIREMENTS], install)


@contextmanager
def running(program: str) -> Iterator[int]:
    """The port of a server."""
    environment = os.environ | {"PYTHONPATH": str(pymodbus())}
    command = [sys.executable, "-c", ON_LOOPBACK, program]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield int(process.stdout.readline())
        finally:
            process.kill()


Call = tuple[str, dict[str, Any], dict[str, Any]]
"""A path, the body of a request beside its target, and a part of the answer."""

OF_PRINTED: list[Call] = [
    # Its blocks begin at 0, and its contexts count from 1: address 0 is the second value.
    ("/connect", {}, {"testRegister": 1}),
    ("/read", {"functionCode": 3, "address": 10, "quantity": 3}, {"values": [11, 12, 13]}),
    ("/read", {"functionCode": 4, "address": 0, "quantity": 2}, {"values": [1, 2]}),
]
OF_CONTAINER: list[Call] = [
    ("/connect", {}, {"testRegister": 0}),
    ("/read", {"functionCode": 4, "address": 65000, "quantity": 2}, {"values": [0, 0]}),
]
OF_BOTH: list[Call] = [
    ("/write/coil", {"address": 17, "value": True}, {"coilValue": 65280, "written": True}),
    ("/read", {"functionCode": 1, "address": 16, "quantity": 3}, {"values": [False, True, False]}),
    ("/read", {"functionCode": 2, "address": 0, "quantity": 2}, {"values": [False, False]}),
    ("/write/registers", {"address": 5, "values": [1234]}, {"startAddress": 5, "quantity": 1}),
    ("/read", {"functionCode": 3, "address": 5}, {"values": [1234]}),
]


@pytest.mark.parametrize(
    ("program", "calls"),
    [(PRINTED, OF_PRINTED), (CONTAINER, OF_CONTAINER)],
    ids=["printed program", "server of the container"],
)
def test_the_gateway_asks_a_simulator(program: str, calls: list[Call]) -> None:
    with running(program) as port, gateways.running() as gateway:
        for path, body, expected in calls + OF_BOTH:
            answer = gateway.ask(path, {"host": "127.0.0.1", "port": port, **body}).json
            assert answer == {**answer, "success": True, **expected}


def test_an_address_that_the_printed_simulator_lacks_is_an_exception() -> None:
    with running(PRINTED) as port, gateways.running() as gateway:
        body = {"host": "127.0.0.1", "port": port, "functionCode": 3, "address": 9999}
        error = gateway.ask("/read", body).json["error"]
    assert error == "Modbus exception: Illegal Data Address (code 0x2)"


TIMEOUTS: list[tuple[str, dict[str, Any], float]] = [
    ("/connect", {}, 10),
    ("/read", {"functionCode": 3, "address": 0}, 10),
    ("/write/coil", {"address": 17, "value": True}, 5),
    ("/write/registers", {"address": 100, "values": [1000, 2000, 3000]}, 5),
    ("/write/coil", {"address": 17, "value": True, "timeout": 3000}, 3),
]


def test_a_request_has_the_printed_timeouts(
    server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[float] = []
    run = Pool.run

    async def recorded(self: Pool, target: Any, timeout: float, *more: Any, **named: Any) -> Any:
        found.append(timeout)
        return await run(self, target, timeout, *more, **named)

    monkeypatch.setattr(Pool, "run", recorded)
    host, port = server.address
    with gateways.running() as gateway:
        for path, body, _ in TIMEOUTS:
            assert gateway.ask(path, {"host": host, "port": port, **body}).json["success"]
    assert found == [expected for *_, expected in TIMEOUTS]


WIRE: list[tuple[str, dict[str, Any], str, str]] = [
    # A path, a body, the PDU of the request, and the PDU of the reply.
    ("/connect", {}, "03 0000 0001", "03 02 002A"),
    (
        "/read",
        {"functionCode": 3, "address": 100, "quantity": 2},
        "03 0064 0002",
        "03 04 04D2 0000",
    ),
    ("/read", {"functionCode": 1, "address": 0, "quantity": 16}, "01 0000 0010", "01 02 0D00"),
    ("/write/coil", {"address": 17, "value": True}, "05 0011 FF00", "05 0011 FF00"),
    ("/write/coil", {"address": 17, "value": 1}, "05 0011 FF00", "05 0011 FF00"),
    ("/write/coil", {"address": 17, "value": False}, "05 0011 0000", "05 0011 0000"),
    ("/write/coil", {"address": 17, "value": 0}, "05 0011 0000", "05 0011 0000"),
    (
        "/write/registers",
        {"address": 100, "values": [1000, 2000, 3000]},
        "10 0064 0003 06 03E8 07D0 0BB8",
        "10 0064 0003",
    ),
]


def test_requests_are_the_described_frames() -> None:
    """A header of 7 bytes with unit id 1, the function code, and big-endian data."""
    replies = {bytes.fromhex(asked): bytes.fromhex(reply) for *_, asked, reply in WIRE}
    with FakeDevice(lambda pdu: replies[pdu]) as device, gateways.running() as gateway:
        for path, body, *_ in WIRE:
            asked = {"host": "127.0.0.1", "port": device.port, **body}
            assert gateway.ask(path, asked).json["success"]
    assert [each.unit for each in device.requests] == [1] * len(WIRE)
    assert [each.pdu for each in device.requests] == [bytes.fromhex(each[2]) for each in WIRE]


REASSEMBLY = """
const [hi, lo] = values; // big-endian word order
const int32 = (hi << 16) | lo;
// or for float:
const buf = new ArrayBuffer(4);
const view = new DataView(buf);
view.setUint16(0, hi); view.setUint16(2, lo);
const float = view.getFloat32(0, false); // big-endian
"""


def test_the_printed_reassembly_of_32_bits_gives_the_typed_values(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0xC1AC, 0x0001])
    host, port = server.address
    asked = {"host": host, "port": port, "functionCode": 3, "address": 0, "quantity": 2}
    with gateways.running() as gateway:
        values = gateway.ask("/read", asked).json["values"]
        typed = [
            gateway.ask("/read", {**asked, "datatype": kind}).json["typed"]
            for kind in ("int32", "float32")
        ]
    program = f"const values = {values};{REASSEMBLY}console.log(JSON.stringify([int32, float]));"
    ran = subprocess.run([tool("node"), "-e", program], capture_output=True, check=True)
    assert [[each] for each in json.loads(ran.stdout)] == typed
    assert typed[0] == [int.from_bytes(b"\xc1\xac\x00\x01", "big", signed=True)]
