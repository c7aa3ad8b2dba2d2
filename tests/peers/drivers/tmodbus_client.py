"""tModbus as a client over TCP, UDP and RTU over TCP."""

from __future__ import annotations

import asyncio
import importlib
import sys
from typing import Any
from urllib.parse import urlsplit

from peers.drivers.json_lines import Answered, answer_all

# It requires Python 3.12: a type checker for 3.11 does not find it.
tmodbus: Any = importlib.import_module("tmodbus")
exceptions: Any = importlib.import_module("tmodbus.exceptions")

CREATE = {
    "tcp": tmodbus.create_async_tcp_client,
    "udp": tmodbus.create_async_udp_client,
    "rtu+tcp": tmodbus.create_async_rtu_over_tcp_client,
}


def run_client(url: str, unit: int) -> None:
    to = urlsplit(url)
    create = CREATE[to.scheme]
    with asyncio.Runner() as runner:
        client = create(to.hostname, to.port, unit_id=unit, timeout=10.0, auto_reconnect=False)
        runner.run(client.connect())

        def execute(operation: dict[str, Any]) -> Any:
            try:
                return runner.run(call(client, operation))
            except exceptions.ModbusResponseError as answer:
                raise Answered(int(answer.error_code)) from None

        answer_all(execute)
        runner.run(client.disconnect())


async def call(client: Any, operation: dict[str, Any]) -> Any:
    at, count = operation.get("address"), operation.get("count")
    values = operation.get("values", [])
    match operation["call"]:
        case "read_coils" | "read_discrete_inputs" as name:
            return [int(bit) for bit in await getattr(client, name)(at, count)]
        case "read_holding_registers" | "read_input_registers" as name:
            return await getattr(client, name)(at, count)
        case "read_write":
            return await client.read_write_multiple_registers(
                operation["read_address"], count, at, values
            )
        case "identify":
            found = await client.read_device_identification(operation["code"], operation["object"])
            return {key: text.decode() for key, text in found.items()}
        case "echo":
            data = await client.diag_read_query_data(words(values))
            return [int.from_bytes(data[at : at + 2]) for at in range(0, len(data), 2)]
    await write(client, operation)
    return None


async def write(client: Any, operation: dict[str, Any]) -> None:
    at, values = operation.get("address"), operation.get("values", [])
    match operation["call"]:
        case "write_coil":
            await client.write_single_coil(at, bool(operation["value"]))
        case "write_register":
            await client.write_single_register(at, operation["value"])
        case "write_coils":
            await client.write_multiple_coils(at, [bool(value) for value in values])
        case "write_registers":
            await client.write_multiple_registers(at, values)
        case "mask_write":
            await client.mask_write_register(at, operation["and"], operation["or"])
        case name:
            raise ValueError(f"there is no call named {name}")


def words(values: list[int]) -> bytes:
    return b"".join(value.to_bytes(2) for value in values)


if __name__ == "__main__":
    run_client(sys.argv[2], int(sys.argv[3]))
