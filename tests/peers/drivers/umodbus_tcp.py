"""uModbus as a client and a server over TCP, and as a client on a serial line in RTU mode."""

from __future__ import annotations

import socket
import socketserver
import sys
from typing import Any
from urllib.parse import urlsplit

import serial  # type: ignore[import-untyped]
from umodbus import exceptions  # type: ignore[import-untyped]
from umodbus.client import tcp  # type: ignore[import-untyped]
from umodbus.client.serial import rtu  # type: ignore[import-untyped]
from umodbus.server.tcp import RequestHandler, get_server  # type: ignore[import-untyped]

from peers.drivers.json_lines import Answered, answer_all, discrete_inputs, input_registers

TIMEOUT = 10.0

READS = {
    name: name
    for name in (
        "read_coils",
        "read_discrete_inputs",
        "read_holding_registers",
        "read_input_registers",
    )
}
WRITES = {
    "write_coil": "write_single_coil",
    "write_register": "write_single_register",
    "write_coils": "write_multiple_coils",
    "write_registers": "write_multiple_registers",
}


def run_client(url: str, unit: int) -> None:
    to = urlsplit(url)
    requests: Any = tcp if to.scheme == "tcp" else rtu
    port: Any
    if to.scheme == "tcp":
        port = socket.create_connection((str(to.hostname), int(to.port or 0)), timeout=TIMEOUT)
    else:
        port = serial.Serial(to.path, 19200, timeout=TIMEOUT)

    def execute(operation: dict[str, Any]) -> Any:
        try:
            reply = requests.send_message(request(requests, unit, operation), port)
        except exceptions.ModbusError as answer:
            raise Answered(answer.error_code) from None
        return reply if operation["call"] in READS else None

    answer_all(execute)


def request(requests: Any, unit: int, operation: dict[str, Any]) -> Any:
    call = operation["call"]
    what = [operation[key] for key in ("count", "value", "values") if key in operation]
    return getattr(requests, (READS | WRITES)[call])(unit, operation["address"], *what)


def run_server() -> None:
    server: Any = get_server(socketserver.TCPServer, ("127.0.0.1", 0), RequestHandler)
    coils, holding = [0] * 1000, [0] * 1000
    serve(server, coils, read=[1], write=[5, 15])
    serve(server, [int(on) for on in discrete_inputs()], read=[2], write=[])
    serve(server, holding, read=[3], write=[6, 16])
    serve(server, input_registers(), read=[4], write=[])
    print(server.server_address[1], flush=True)
    server.serve_forever()


def serve(server: Any, area: list[int], read: list[int], write: list[int]) -> None:
    """Serves an area by these functions."""

    def reading(**asked: int) -> int:
        return area[asked["address"]]

    def writing(**asked: int) -> None:
        area[asked["address"]] = asked["value"]

    for codes, endpoint in ((read, reading), (write, writing)):
        for code in codes:
            server.route([1], [code], range(len(area)))(endpoint)


if __name__ == "__main__":
    if sys.argv[1] == "client":
        run_client(sys.argv[2], int(sys.argv[3]))
    else:
        run_server()
