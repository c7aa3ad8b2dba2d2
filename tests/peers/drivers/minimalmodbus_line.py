"""MinimalModbus as a client on a serial line, in RTU or ASCII mode. It has no server."""

from __future__ import annotations

import sys
from typing import Any
from urllib.parse import urlsplit

import minimalmodbus  # type: ignore[import-untyped]
import serial  # type: ignore[import-untyped]

from peers.drivers.json_lines import Answered, answer_all

CODES = {
    "Slave reported illegal function": 1,
    "Slave reported illegal data address": 2,
    "Slave reported illegal data value": 3,
}
"""Its errors have no codes, only texts."""


class Rtu(serial.Serial):  # type: ignore[misc]
    """A port that reads as much as an exception has, in place of all that a reply would have.

    MinimalModbus asks for the length of the reply, so that each exception takes a timeout.
    """

    def read(self, size: int = 1) -> bytes:
        start: bytes = super().read(2)
        return start + bytes(super().read(3 if start[1:] > b"\x80" else size - 2))


class Ascii(serial.Serial):  # type: ignore[misc]
    """The same for ASCII mode."""

    def read(self, size: int = 1) -> bytes:  # noqa: ARG002
        frame = b""
        while (byte := bytes(super().read(1))) and not frame.endswith(b"\r"):
            frame += byte
        return frame + byte


def run_client(url: str, unit: int) -> None:
    line = urlsplit(url)
    # The timeout is long, for a loaded machine.
    port = (Rtu if line.scheme == "rtu" else Ascii)(line.path, 19200, timeout=10.0)
    device: Any = minimalmodbus.Instrument(port, unit, mode=line.scheme)

    def execute(operation: dict[str, Any]) -> Any:
        try:
            return call(device, operation)
        except minimalmodbus.SlaveReportedException as error:
            raise Answered(CODES[str(error)]) from None

    answer_all(execute)


def call(device: Any, operation: dict[str, Any]) -> Any:
    at, count = operation.get("address"), operation.get("count")
    values = operation.get("values", [])
    match operation["call"]:
        case "read_coils":
            return device.read_bits(at, count, functioncode=1)
        case "read_discrete_inputs":
            return device.read_bits(at, count, functioncode=2)
        case "read_holding_registers":
            return device.read_registers(at, count, functioncode=3)
        case "read_input_registers":
            return device.read_registers(at, count, functioncode=4)
        case "write_coil":
            return device.write_bit(at, operation["value"])
        case "write_register":
            return device.write_register(at, operation["value"], functioncode=6)
        case "write_coils":
            return device.write_bits(at, values)
        case "write_registers":
            return device.write_registers(at, values)
    raise ValueError(f"there is no call named {operation['call']}")


if __name__ == "__main__":
    run_client(sys.argv[2], int(sys.argv[3]))
