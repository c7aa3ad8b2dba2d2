"""The endpoints that write coils and holding registers, with masks and combined reads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.gateway.endpoint import (
    EXAMPLE,
    MILLISECONDS,
    REGISTERS,
    TARGET,
    Endpoint,
    always,
)
from holdfast.gateway.fields import (
    ADDRESS,
    ADDRESS_SCHEMA,
    BIT,
    BYTE_ORDER,
    DATATYPE,
    REGISTER,
    TYPED_SCHEMA,
)
from holdfast.gateway.typed import typed
from holdfast.protocol import (
    ADDRESSES,
    LAST_ADDRESS,
    MAX_WORD,
    READ_WRITE,
    WRITE_BITS,
    WRITE_REGISTERS,
)
from holdfast.web.fields import Field, malformed
from holdfast.web.schemas import array, integer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given

ON = 0xFF00
TIMEOUT = 5_000


async def _write_coil(given: Given, device: RequestedDevice) -> Answer:
    address, value = given["address"], bool(given["value"])
    await device.ask(lambda client: client.write_coil(address, value, unit=device.unit))
    return {
        "success": True,
        **device.told,
        "address": address,
        "coilValue": ON if value else 0,
        "written": value,
        "rtt": device.rtt,
    }


async def _write_coils(given: Given, device: RequestedDevice) -> Answer:
    address, values = given["address"], [bool(each) for each in given["values"]]
    _check_end(address, len(values))
    await device.ask(lambda client: client.write_coils(address, values, unit=device.unit))
    return _written(device, address, len(values))


async def _write_register(given: Given, device: RequestedDevice) -> Answer:
    address, value = given["address"], given["value"]
    await device.ask(lambda client: client.write_register(address, value, unit=device.unit))
    return {
        "success": True,
        **device.told,
        "address": address,
        "value": value,
        "rtt": device.rtt,
    }


async def _write_registers(given: Given, device: RequestedDevice) -> Answer:
    address, values = given["address"], _registers(given)
    _check_end(address, len(values))
    await device.ask(lambda client: client.write_registers(address, values, unit=device.unit))
    return _written(device, address, len(values))


async def _mask(given: Given, device: RequestedDevice) -> Answer:
    address, and_mask, or_mask = given["address"], given["andMask"], given["orMask"]
    await device.ask(
        lambda client: client.mask_write(
            address, and_mask=and_mask, or_mask=or_mask, unit=device.unit
        )
    )
    masks = {"andMask": and_mask, "orMask": or_mask}
    return {"success": True, **device.told, "address": address, **masks, "rtt": device.rtt}


async def _read_write(given: Given, device: RequestedDevice) -> Answer:
    first, quantity = given["readAddress"], given["readQuantity"]
    address, values = given["writeAddress"], given["values"]
    _check_end(first, quantity)
    _check_end(address, len(values))
    found = await device.ask(
        lambda client: client.read_write(first, quantity, address, values, unit=device.unit)
    )
    return {
        "success": True,
        **device.told,
        "writeAddress": address,
        "written": len(values),
        "readAddress": first,
        "quantity": quantity,
        "format": "registers",
        "values": found,
        "rtt": device.rtt,
    }


def _written(device: RequestedDevice, address: int, quantity: int) -> Answer:
    return {
        "success": True,
        **device.told,
        "startAddress": address,
        "quantity": quantity,
        "rtt": device.rtt,
    }


def _registers(given: Given) -> Sequence[int]:
    """Returns the registers to write. Raises `BadRequest`."""
    kind = typed(given["datatype"], given["byteOrder"], "holding_registers")
    if kind is not None:
        return kind.encode(given["values"])
    return [Field(f"values[{at}]", REGISTER, "").check(v) for at, v in enumerate(given["values"])]


def _check_end(address: int, count: int) -> None:
    if address + count > ADDRESSES:
        raise malformed(f"{count} from address {address}: the last address is {LAST_ADDRESS}")


def _values(items: dict[str, Any], most: int, text: str) -> Field:
    return Field("values", array(items, most), text)


_WRITTEN = {
    "startAddress": ADDRESS_SCHEMA,
    "quantity": integer(1, WRITE_BITS),
    "rtt": MILLISECONDS,
}

ENDPOINTS = (
    Endpoint(
        "/api/modbus/write/coil",
        "writeCoil",
        "Write one coil",
        (*TARGET, ADDRESS, Field("value", BIT, "`true` or 1 is on, `false` or 0 is off")),
        _write_coil,
        {
            "address": ADDRESS_SCHEMA,
            "coilValue": {"enum": [0, ON]},
            "written": {"type": "boolean", "description": "Whether the coil is now on"},
            "rtt": MILLISECONDS,
        },
        {"Coil 17 on": {**EXAMPLE, "address": 17, "value": True}},
        {**EXAMPLE, "address": 17, "coilValue": ON, "written": True, "rtt": 12},
        "Function 5. `coilValue` is the value in the Modbus frame: 65280 is on.",
        writes=always,
        broadcast=True,
        timeout=TIMEOUT,
    ),
    Endpoint(
        "/api/modbus/write/registers",
        "writeRegisters",
        "Write holding registers",
        (
            *TARGET,
            ADDRESS,
            _values(
                TYPED_SCHEMA,
                WRITE_REGISTERS,
                f"Up to {WRITE_REGISTERS} register values 0 to {MAX_WORD}; with `datatype`, values "
                "of that type, bytes in hex",
            ),
            DATATYPE,
            BYTE_ORDER,
        ),
        _write_registers,
        _WRITTEN,
        {
            "Three registers": {**EXAMPLE, "address": 100, "values": [1000, 2000, 3000]},
            "A float, low word first": {
                **EXAMPLE,
                "address": 100,
                "values": [21.5],
                "datatype": "float32",
                "byteOrder": "CDAB",
            },
        },
        {**EXAMPLE, "startAddress": 100, "quantity": 3, "rtt": 14},
        "Function 16. A value that does not fit is refused, never truncated or wrapped.",
        writes=always,
        broadcast=True,
        timeout=TIMEOUT,
    ),
    Endpoint(
        "/api/modbus/write/register",
        "writeRegister",
        "Write one holding register",
        (*TARGET, ADDRESS, Field("value", REGISTER, f"0 to {MAX_WORD}")),
        _write_register,
        {"address": ADDRESS_SCHEMA, "value": REGISTER, "rtt": MILLISECONDS},
        {"Register 5": {**EXAMPLE, "address": 5, "value": 1234}},
        {**EXAMPLE, "address": 5, "value": 1234, "rtt": 12},
        "Function 6.",
        writes=always,
        broadcast=True,
        timeout=TIMEOUT,
    ),
    Endpoint(
        "/api/modbus/write/coils",
        "writeCoils",
        "Write coils",
        (
            *TARGET,
            ADDRESS,
            _values(BIT, WRITE_BITS, f"Up to {WRITE_BITS} of `true`, `false`, 1, 0"),
        ),
        _write_coils,
        _WRITTEN,
        {"Three coils": {**EXAMPLE, "address": 16, "values": [True, False, True]}},
        {**EXAMPLE, "startAddress": 16, "quantity": 3, "rtt": 12},
        "Function 15.",
        writes=always,
        broadcast=True,
        timeout=TIMEOUT,
    ),
    Endpoint(
        "/api/modbus/write/mask",
        "writeMask",
        "Change bits of one holding register",
        (
            *TARGET,
            ADDRESS,
            Field("andMask", REGISTER, "Bits to keep"),
            Field("orMask", REGISTER, "New values of the other bits"),
        ),
        _mask,
        {
            "address": ADDRESS_SCHEMA,
            "andMask": REGISTER,
            "orMask": REGISTER,
            "rtt": MILLISECONDS,
        },
        {"Set bit 3": {**EXAMPLE, "address": 4, "andMask": 0xFFF7, "orMask": 8}},
        {**EXAMPLE, "address": 4, "andMask": 0xFFF7, "orMask": 8, "rtt": 12},
        "Function 22. Atomically sets the register to `(now & andMask) | (orMask & ~andMask)`.",
        writes=always,
        broadcast=True,
        timeout=TIMEOUT,
    ),
    Endpoint(
        "/api/modbus/readwrite",
        "readWrite",
        "Write holding registers, then read some, in one request",
        (
            *TARGET,
            Field("readAddress", ADDRESS_SCHEMA, "The first address to read"),
            Field(
                "readQuantity", integer(1, READ_WRITE.most_read), "The number of registers to read"
            ),
            Field("writeAddress", ADDRESS_SCHEMA, "The first address to write"),
            _values(
                REGISTER,
                READ_WRITE.most_written,
                f"Registers to write, up to {READ_WRITE.most_written}",
            ),
        ),
        _read_write,
        {
            "writeAddress": ADDRESS_SCHEMA,
            "written": integer(1, READ_WRITE.most_written),
            "readAddress": ADDRESS_SCHEMA,
            "quantity": integer(1, READ_WRITE.most_read),
            "format": {"const": "registers"},
            "values": REGISTERS,
            "rtt": MILLISECONDS,
        },
        {
            "Write two, read three": {
                **EXAMPLE,
                "readAddress": 0,
                "readQuantity": 3,
                "writeAddress": 100,
                "values": [7, 8],
            }
        },
        {
            **EXAMPLE,
            "writeAddress": 100,
            "written": 2,
            "readAddress": 0,
            "quantity": 3,
            "format": "registers",
            "values": [11, 22, 33],
            "rtt": 12,
        },
        "Function 23. The device writes before it reads.",
        writes=always,
        timeout=TIMEOUT,
    ),
)
