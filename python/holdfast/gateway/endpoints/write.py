"""The endpoints that write coils and holding registers, with masks and combined reads."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from holdfast.gateway.endpoint import EXAMPLE, REGISTERS, Endpoint, always
from holdfast.gateway.endpoints.typed import parse_value_type
from holdfast.gateway.fields import (
    ADDRESS,
    ADDRESS_SCHEMA,
    BIT,
    BYTE_ORDER,
    DATATYPE,
    REGISTER,
    TYPED_VALUE_SCHEMA,
    WRITE_TIMEOUT_MS,
    check_end,
)
from holdfast.net.http.fields import Field
from holdfast.net.http.schemas import BOOLEAN, Schema, array, integer
from holdfast.protocol import MAX_WORD, READ_WRITE, WRITE_BITS, WRITE_REGISTERS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given

ON = 0xFF00


async def _write_coil(given: Given, device: RequestedDevice) -> Answer:
    address, value = given["address"], bool(given["value"])
    await device.ask(lambda client: client.write_coil(address, value))
    return {"address": address, "coilValue": ON if value else 0, "written": value}


async def _write_coils(given: Given, device: RequestedDevice) -> Answer:
    address, values = given["address"], [bool(each) for each in given["values"]]
    check_end(address, len(values))
    await device.ask(lambda client: client.write_coils(address, values))
    return {"startAddress": address, "quantity": len(values)}


async def _write_register(given: Given, device: RequestedDevice) -> Answer:
    address, value = given["address"], given["value"]
    await device.ask(lambda client: client.write_register(address, value))
    return {"address": address, "value": value}


async def _write_registers(given: Given, device: RequestedDevice) -> Answer:
    address, values = given["address"], _registers(given)
    check_end(address, len(values))
    await device.ask(lambda client: client.write_registers(address, values))
    return {"startAddress": address, "quantity": len(values)}


async def _mask(given: Given, device: RequestedDevice) -> Answer:
    address, and_mask, or_mask = given["address"], given["andMask"], given["orMask"]
    await device.ask(lambda client: client.mask_write(address, and_mask=and_mask, or_mask=or_mask))
    return {"address": address, "andMask": and_mask, "orMask": or_mask}


async def _read_write(given: Given, device: RequestedDevice) -> Answer:
    first, quantity = given["readAddress"], given["readQuantity"]
    address, values = given["writeAddress"], given["values"]
    check_end(first, quantity)
    check_end(address, len(values))
    found = await device.ask(lambda client: client.read_write(first, quantity, address, values))
    return {
        "writeAddress": address,
        "written": len(values),
        "readAddress": first,
        "quantity": quantity,
        "format": "registers",
        "values": found,
    }


def _registers(given: Given) -> Sequence[int]:
    """Returns the registers to write. Raises `BadRequest`."""
    kind = parse_value_type(given["datatype"], given["byteOrder"], "holding_registers")
    if kind is not None:
        return kind.encode(given["values"])
    checked: Sequence[int] = REGISTER_VALUES.check(given["values"])
    return checked


def _values(items: dict[str, Any], most: int, text: str) -> Field:
    return Field("values", array(items, most), text)


REGISTER_VALUES = _values(REGISTER, WRITE_REGISTERS, "")
"""What `values` must be without a datatype. The schema of the request allows values of any type."""


def _written(most: int) -> dict[str, Schema]:
    return {"startAddress": ADDRESS_SCHEMA, "quantity": integer(1, most)}


_write = partial(Endpoint, writes=always, broadcast=True, timeout_ms=WRITE_TIMEOUT_MS)

ENDPOINTS = (
    _write(
        path="/api/modbus/write/coil",
        name="writeCoil",
        summary="Write one coil",
        description="Function 5. `coilValue` is the value in the Modbus frame: 65280 is on.",
        fields=(ADDRESS, Field("value", BIT, "`true` or 1 is on, `false` or 0 is off")),
        execute=_write_coil,
        properties={
            "address": ADDRESS_SCHEMA,
            "coilValue": {"enum": [0, ON]},
            "written": BOOLEAN | {"description": "Whether the coil is now on"},
        },
        examples={"Coil 17 on": {**EXAMPLE, "address": 17, "value": True}},
        answer={"address": 17, "coilValue": ON, "written": True},
    ),
    _write(
        path="/api/modbus/write/registers",
        name="writeRegisters",
        summary="Write holding registers",
        description=(
            "Function 16. A value that does not fit is refused, never truncated or wrapped."
        ),
        fields=(
            ADDRESS,
            _values(
                TYPED_VALUE_SCHEMA,
                WRITE_REGISTERS,
                f"Up to {WRITE_REGISTERS} register values 0 to {MAX_WORD}; with `datatype`, values "
                "of that type, bytes in hex",
            ),
            DATATYPE,
            BYTE_ORDER,
        ),
        execute=_write_registers,
        properties=_written(WRITE_REGISTERS),
        examples={
            "Three registers": {**EXAMPLE, "address": 100, "values": [1000, 2000, 3000]},
            "A float, low word first": {
                **EXAMPLE,
                "address": 100,
                "values": [21.5],
                "datatype": "float32",
                "byteOrder": "CDAB",
            },
        },
        answer={"startAddress": 100, "quantity": 3},
    ),
    _write(
        path="/api/modbus/write/register",
        name="writeRegister",
        summary="Write one holding register",
        description="Function 6.",
        fields=(ADDRESS, Field("value", REGISTER, f"0 to {MAX_WORD}")),
        execute=_write_register,
        properties={"address": ADDRESS_SCHEMA, "value": REGISTER},
        examples={"Register 5": {**EXAMPLE, "address": 5, "value": 1234}},
        answer={"address": 5, "value": 1234},
    ),
    _write(
        path="/api/modbus/write/coils",
        name="writeCoils",
        summary="Write coils",
        description="Function 15.",
        fields=(
            ADDRESS,
            _values(BIT, WRITE_BITS, f"Up to {WRITE_BITS} of `true`, `false`, 1, 0"),
        ),
        execute=_write_coils,
        properties=_written(WRITE_BITS),
        examples={"Three coils": {**EXAMPLE, "address": 16, "values": [True, False, True]}},
        answer={"startAddress": 16, "quantity": 3},
    ),
    _write(
        path="/api/modbus/write/mask",
        name="writeMask",
        summary="Change bits of one holding register",
        description=(
            "Function 22. Atomically sets the register to `(now & andMask) | (orMask & ~andMask)`."
        ),
        fields=(
            ADDRESS,
            Field("andMask", REGISTER, "Bits to keep"),
            Field("orMask", REGISTER, "New values of the other bits"),
        ),
        execute=_mask,
        properties={"address": ADDRESS_SCHEMA, "andMask": REGISTER, "orMask": REGISTER},
        examples={"Set bit 3": {**EXAMPLE, "address": 4, "andMask": 0xFFF7, "orMask": 8}},
        answer={"address": 4, "andMask": 0xFFF7, "orMask": 8},
    ),
    _write(
        path="/api/modbus/readwrite",
        name="readWrite",
        summary="Write holding registers, then read some, in one request",
        description="Function 23. The device writes before it reads.",
        fields=(
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
        execute=_read_write,
        properties={
            "writeAddress": ADDRESS_SCHEMA,
            "written": integer(1, READ_WRITE.most_written),
            "readAddress": ADDRESS_SCHEMA,
            "quantity": integer(1, READ_WRITE.most_read),
            "format": {"const": "registers"},
            "values": REGISTERS,
        },
        examples={
            "Write two, read three": {
                **EXAMPLE,
                "readAddress": 0,
                "readQuantity": 3,
                "writeAddress": 100,
                "values": [7, 8],
            }
        },
        answer={
            "writeAddress": 100,
            "written": 2,
            "readAddress": 0,
            "quantity": 3,
            "format": "registers",
            "values": [11, 22, 33],
        },
        broadcast=False,
    ),
)
