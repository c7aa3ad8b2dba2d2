"""pyModbusTCP as a client and a server."""

from __future__ import annotations

import socket
import sys
from typing import Any
from urllib.parse import urlsplit

from pyModbusTCP.client import ModbusClient  # type: ignore[import-untyped]
from pyModbusTCP.server import (  # type: ignore[import-untyped]
    DataBank,
    DeviceIdentification,
    ModbusServer,
)

from peers.drivers.json_lines import Answered, answer_all, discrete_inputs, input_registers


def run_client(url: str, unit: int) -> None:
    to = urlsplit(url)
    client: Any = ModbusClient(host=to.hostname, port=to.port, unit_id=unit, timeout=10.0)

    def execute(operation: dict[str, Any]) -> Any:
        reply = call(client, operation)
        if client.last_except:
            raise Answered(client.last_except)
        if reply is None or reply is False:
            raise ConnectionError(client.last_error_as_txt)
        return None if reply is True else reply

    answer_all(execute)


def call(client: Any, operation: dict[str, Any]) -> Any:
    at, count = operation.get("address"), operation.get("count")
    values = operation.get("values", [])
    match operation["call"]:
        case "read_coils" | "read_discrete_inputs" as name:
            bits = getattr(client, name)(at, count)
            return bits and [int(bit) for bit in bits]
        case "read_holding_registers" | "read_input_registers" as name:
            return getattr(client, name)(at, count)
        case "write_coil":
            return client.write_single_coil(at, bool(operation["value"]))
        case "write_register":
            return client.write_single_register(at, operation["value"])
        case "write_coils":
            return client.write_multiple_coils(at, [bool(value) for value in values])
        case "write_registers":
            return client.write_multiple_registers(at, values)
        case "read_write":
            return client.write_read_multiple_registers(
                at, values, operation["read_address"], count
            )
        case "identify":
            reply = client.read_device_identification(operation["code"], operation["object"])
            return reply and {key: text.decode() for key, text in reply.objects_by_id.items()}
    raise ValueError(f"there is no call named {operation['call']}")


def run_server() -> None:
    # The server does not tell its port: it gets a socket's that was free.
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    bank = DataBank(coils_size=1000, d_inputs_size=1000, h_regs_size=1000, i_regs_size=1000)
    bank.set_discrete_inputs(0, discrete_inputs())
    bank.set_input_registers(0, input_registers())
    names = DeviceIdentification(
        vendor_name=b"Acme", product_code=b"P1", major_minor_revision=b"1.2"
    )
    server: Any = ModbusServer("127.0.0.1", port, no_block=True, data_bank=bank, device_id=names)
    server.start()
    print(port, flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    if sys.argv[1] == "client":
        run_client(sys.argv[2], int(sys.argv[3]))
    else:
        run_server()
