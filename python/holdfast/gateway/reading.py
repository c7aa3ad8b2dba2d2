"""The endpoints that check a connection, and that read the four areas of a device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.errors import ModbusException
from holdfast.gateway.device import exception_name, exception_text
from holdfast.gateway.endpoint import EXAMPLE, TARGET, Endpoint
from holdfast.gateway.fields import ADDRESS, ADDRESS_SCHEMA, BYTE_ORDER, DATATYPE, REGISTER
from holdfast.gateway.typed import quantity_of, typed
from holdfast.protocol import (
    ADDRESSES,
    LAST_ADDRESS,
    MAX_WORD,
    READ_BITS,
    READ_FUNCTIONS,
    READ_LIMITS,
    READ_REGISTERS,
)
from holdfast.types import BIT_AREAS
from holdfast.web.fields import Field, malformed, told
from holdfast.web.schemas import Schema, array_of, integer

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast.client import Client
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given
    from holdfast.gateway.typed import Typed
    from holdfast.types import Area

AREAS_READ = {each.code: area for area, each in READ_FUNCTIONS.items()}
FUNCTIONS = {each.code: each for each in READ_FUNCTIONS.values()}
FUNCTION_SCHEMA = integer(min(FUNCTIONS), max(FUNCTIONS))
ALLOWED = ", ".join(f"0x{code:02x} ({each.name})" for code, each in FUNCTIONS.items())


def not_a_read_function(value: Any) -> str:
    """Returns the error for another function code than those of reads."""
    code = f"0x{value:x}" if type(value) is int else told(value)
    return f"Invalid read function code: {code}. Allowed: {ALLOWED}"


FUNCTION = Field(
    "functionCode",
    {"type": "integer", "enum": list(FUNCTIONS)},
    ", ".join(f"{code} {area.replace('_', ' ')}" for area, (code, *_) in READ_FUNCTIONS.items()),
    refusal=not_a_read_function,
    example=3,
)
QUANTITY = Field(
    "quantity",
    integer(1, READ_BITS),
    f"Number of bits, up to {READ_BITS}, or registers, up to {READ_REGISTERS}; default 1, or the "
    "size of the datatype",
    None,
    allowed=f"an integer 1 to {READ_REGISTERS} for registers, 1 to {READ_BITS} for bits",
    example=10,
)


class Range:
    """The range that a request reads. Raises `BadRequest` if one read can't cover it."""

    def __init__(self, given: Given) -> None:
        self.function: int = given["functionCode"]
        self.area: Area = AREAS_READ[self.function]
        self.address: int = given["address"]
        self.kind: Typed | None = typed(given["datatype"], given["byteOrder"], self.area)
        self.quantity = quantity_of(given["quantity"], self.kind)
        limit = READ_LIMITS[self.area]
        if not 1 <= self.quantity <= limit:
            raise malformed(f"Quantity must be between 1 and {limit}, found {self.quantity}")
        if self.address + self.quantity > ADDRESSES:
            raise malformed(
                f"{self.quantity} from address {self.address}: the last address is {LAST_ADDRESS}"
            )

    @property
    def format(self) -> str:
        """The format of the values, `coils` or `registers`."""
        return "coils" if self.area in BIT_AREAS else "registers"

    async def read(self, device: RequestedDevice) -> list[Any]:
        """Reads the values: booleans, or integers 0 to 65535."""
        return await device.ask(self._call(device.unit))

    def _call(self, unit: int) -> Callable[[Client], Awaitable[list[Any]]]:
        def call(client: Client) -> Awaitable[list[Any]]:
            reads: dict[Area, Callable[..., Awaitable[list[Any]]]] = {
                "coils": client.read_coils,
                "discrete_inputs": client.read_discrete_inputs,
                "holding_registers": client.read_holding_registers,
                "input_registers": client.read_input_registers,
            }
            return reads[self.area](self.address, self.quantity, unit=unit)

        return call


async def _connect(_: Given, device: RequestedDevice) -> Answer:
    answer = {"success": True, "message": "Modbus server reachable", **device.told}
    try:
        [register] = await device.ask(
            lambda client: client.read_holding_registers(0, 1, unit=device.unit)
        )
    except ModbusException as error:
        answer["message"] += " (responded with exception)"
        return {**answer, "exception": exception_name(error)}
    return {**answer, "testRegister": register}


async def _read(given: Given, device: RequestedDevice) -> Answer:
    asked = Range(given)
    found = await asked.read(device)
    return {
        "success": True,
        **device.told,
        "functionCode": asked.function,
        "functionName": FUNCTIONS[asked.function].name.upper().replace(" ", "_"),
        "address": asked.address,
        "quantity": asked.quantity,
        "format": asked.format,
        "values": found,
        **({} if asked.kind is None else asked.kind.decode(found)),
    }


def _read_exception(given: Given, _: RequestedDevice, error: ModbusException) -> Answer:
    return {
        "success": False,
        "error": exception_text(error),
        "functionCode": given["functionCode"],
        "address": given["address"],
        "quantity": Range(given).quantity,
    }


TYPED: dict[str, Schema] = {
    "typed": {"type": "array", "description": "With `datatype`: the values, `null` if invalid"},
    "typedText": {
        "type": "array",
        "items": {"type": "string"},
        "description": "The values as text; floats have the fewest digits that identify them",
    },
    "typedErrors": {
        "type": "object",
        "additionalProperties": {"type": "string"},
        "description": "By index in `typed`: why the value is invalid",
    },
}

ENDPOINTS = (
    Endpoint(
        "/api/modbus/connect",
        "connect",
        "Check whether a device responds",
        TARGET,
        _connect,
        {
            "message": {"type": "string"},
            "testRegister": REGISTER,
            "exception": {"type": "string"},
        },
        {"A device on port 502": {"host": "plc.factory.local", "unitId": 1}},
        {"message": "Modbus server reachable", **EXAMPLE, "testRegister": 42},
        "Reads holding register 0. A Modbus exception also shows that the device is reachable.",
        optional=("testRegister", "exception"),
    ),
    Endpoint(
        "/api/modbus/read",
        "read",
        "Read coils, discrete inputs, holding or input registers",
        (*TARGET, FUNCTION, ADDRESS, QUANTITY, DATATYPE, BYTE_ORDER),
        _read,
        {
            "functionCode": FUNCTION_SCHEMA,
            "functionName": {"type": "string"},
            "address": ADDRESS_SCHEMA,
            "quantity": integer(1, READ_BITS),
            "format": {"enum": ["coils", "registers"]},
            "values": array_of({**REGISTER, "type": ["integer", "boolean"]}),
            **TYPED,
        },
        {
            "Five registers": {**EXAMPLE, "functionCode": 3, "address": 100, "quantity": 5},
            "Two floats, low word first": {
                **EXAMPLE,
                "functionCode": 4,
                "address": 0,
                "datatype": "float32[2]",
                "byteOrder": "CDAB",
            },
        },
        {
            **EXAMPLE,
            "functionCode": 3,
            "functionName": "READ_HOLDING_REGISTERS",
            "address": 100,
            "quantity": 5,
            "format": "registers",
            "values": [1234, 0, 65535, 42, 7],
        },
        f"Functions 1 to 4. `values` are booleans, or register values 0 to {MAX_WORD}.",
        optional=tuple(TYPED),
        on_exception=_read_exception,
    ),
)
