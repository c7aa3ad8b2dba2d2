"""Reading: is a device there, and what do its four areas hold?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.client.requests import ADDRESSES, READ_LIMITS
from holdfast.errors import ModbusException
from holdfast.gateway.device import exception_name, exception_text
from holdfast.gateway.endpoint import EXAMPLE, TARGET, Operation, array_of
from holdfast.gateway.fields import (
    ADDRESS,
    BYTE_ORDER,
    DATATYPE,
    Field,
    Schema,
    integer,
    malformed,
    told,
)
from holdfast.gateway.typed import quantity_of, typed
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast.client import Client
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given
    from holdfast.gateway.typed import Typed
    from holdfast.types import Area

FUNCTION_NAMES = (
    "READ_COILS",
    "READ_DISCRETE_INPUTS",
    "READ_HOLDING_REGISTERS",
    "READ_INPUT_REGISTERS",
)
ALLOWED = (
    "0x01 (Read Coils), 0x02 (Read Discrete Inputs), 0x03 (Read Holding Registers), "
    "0x04 (Read Input Registers)"
)


def _no_read_function(value: Any) -> str:
    code = f"0x{value:x}" if type(value) is int else told(value)
    return f"Invalid read function code: {code}. Allowed: {ALLOWED}"


FUNCTION = Field(
    "functionCode",
    {"type": "integer", "enum": [1, 2, 3, 4]},
    "1 coils, 2 discrete inputs, 3 holding registers, 4 input registers",
    refusal=_no_read_function,
)
QUANTITY = Field(
    "quantity",
    integer(1, 2000),
    "How many, up to 2000 bits or 125 registers; 1 if left out, or what the datatype takes",
    None,
    allowed="an integer 1 to 125 for registers, 1 to 2000 for bits",
)


class Range:
    """What a request reads. Raises `BadRequest` for what can't be read at once."""

    def __init__(self, given: Given) -> None:
        self.function: int = given["functionCode"]
        self.area: Area = AREAS[self.function - 1]
        self.address: int = given["address"]
        self.kind: Typed | None = typed(given["datatype"], given["byteOrder"], self.area)
        self.quantity = quantity_of(given["quantity"], self.kind)
        limit = READ_LIMITS[self.area]
        if not 1 <= self.quantity <= limit:
            raise malformed(f"Quantity must be between 1 and {limit}, found {self.quantity}")
        if self.address + self.quantity > ADDRESSES:
            raise malformed(f"{self.quantity} from address {self.address}: the last is 65535")

    @property
    def format(self) -> str:
        """What its values are."""
        return "coils" if self.area in BIT_AREAS else "registers"

    async def read(self, device: RequestedDevice) -> list[Any]:
        """The values of now: booleans, or integers 0 to 65535."""
        return await device.ask(self._call(device.unit), repeat=True)

    def _call(self, unit: int) -> Callable[[Client], Awaitable[list[Any]]]:
        def call(client: Client) -> Awaitable[list[Any]]:
            reads = (
                client.read_coils,
                client.read_discrete_inputs,
                client.read_holding_registers,
                client.read_input_registers,
            )
            return reads[self.function - 1](self.address, self.quantity, unit=unit)

        return call


async def _connect(_: Given, device: RequestedDevice) -> Answer:
    answer = {"success": True, "message": "Modbus server reachable", **device.told}
    try:
        [register] = await device.ask(
            lambda client: client.read_holding_registers(0, 1, unit=device.unit), repeat=True
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
        "functionName": FUNCTION_NAMES[asked.function - 1],
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
    "typed": {"type": "array", "description": "With `datatype`: the values, `null` where none is"},
    "typedText": {
        "type": "array",
        "items": {"type": "string"},
        "description": "The same for people: floats as short as can be",
    },
    "typedErrors": {
        "type": "object",
        "additionalProperties": {"type": "string"},
        "description": "By place in `typed`: why there is no value",
    },
}

ENDPOINTS = (
    Operation(
        "/api/modbus/connect",
        "connect",
        "Whether a device answers",
        TARGET,
        _connect,
        {
            "message": {"type": "string"},
            "testRegister": integer(0, 65535),
            "exception": {"type": "string"},
        },
        {"A device on port 502": {"host": "plc.factory.local", "unitId": 1}},
        {"message": "Modbus server reachable", **EXAMPLE, "testRegister": 42},
        "Reads holding register 0. A Modbus exception is an answer too: the device is there.",
        optional=("testRegister", "exception"),
    ),
    Operation(
        "/api/modbus/read",
        "read",
        "Read coils, discrete inputs, holding or input registers",
        (*TARGET, FUNCTION, ADDRESS, QUANTITY, DATATYPE, BYTE_ORDER),
        _read,
        {
            "functionCode": integer(1, 4),
            "functionName": {"type": "string"},
            "address": integer(0, 65535),
            "quantity": integer(1, 2000),
            "format": {"enum": ["coils", "registers"]},
            "values": array_of({"type": ["integer", "boolean"], "minimum": 0, "maximum": 65535}),
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
        "Functions 1 to 4. `values` are booleans, or registers 0 to 65535.",
        optional=tuple(TYPED),
        on_exception=_read_exception,
    ),
)
