"""Runs the pymodbus server under test: 1,000 holding registers, unit 1."""

from __future__ import annotations

import asyncio
import socket

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port: int = taken.getsockname()[1]
        return port


async def main() -> None:
    registers = SimData(address=0, values=list(range(1000)), datatype=DataType.REGISTERS)
    device = SimDevice(id=1, simdata=[registers])
    port = free_port()
    server = ModbusTcpServer(device, address=("127.0.0.1", port))
    await server.serve_forever(background=True)
    print(f"listening 127.0.0.1:{port}", flush=True)
    await asyncio.Event().wait()


asyncio.run(main())
