"""The endpoints that check a connection, and that read the four areas of a device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.errors import ModbusException
from holdfast.gateway.device import exception_name, exception_text
from holdfast.gateway.endpoint import EXAMPLE, Endpoint
from holdfast.gateway.endpoints.typed import parse_value_type, quantity_of
from holdfast.gateway.fields import (
    ADDRESS,
    ADDRESS_SCHEMA,
    BYTE_ORDER,
    DATATYPE,
    REGISTER,
    check_end,
)
from holdfast.net.http.fields import Field, malformed, value_text
from holdfast.net.http.schemas import TEXT, Schema, array_of, integer, map_of
from holdfast.protocol import MAX_WORD, READ_BITS, READ_FUNCTIONS, READ_LIMITS, READ_REGISTERS
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given
    from holdfast.gateway.endpoints.typed import ValueType
    from holdfast.types import Area

AREAS_READ = {each.code: area for area, each in READ_FUNCTIONS.items()}
FUNCTIONS = {each.code: each for each in READ_FUNCTIONS.values()}
FUNCTION_SCHEMA = integer(min(FUNCTIONS), max(FUNCTIONS))
ALLOWED = ", ".join(f"0x{code:02x} ({each.name})" for code, each in FUNCTIONS.items())


def not_a_read_function(value: Any) -> str:
    """Returns the error for another function code than those of reads."""
    code = f"0x{value:x}" if type(value) is int else value_text(value)
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
RANGE = (FUNCTION, ADDRESS, QUANTITY, DATATYPE, BYTE_ORDER)
"""The fields of a `Range`."""


class Range:
    """The range that a request reads. Raises `BadRequest` if one read can't cover it."""

    def __init__(self, given: Given) -> None:
        self.function: int = given["functionCode"]
        self.area: Area = AREAS_READ[self.function]
        self.address: int = given["address"]
        self.kind: ValueType | None = parse_value_type(
            given["datatype"], given["byteOrder"], self.area
        )
        self.quantity = quantity_of(given["quantity"], self.kind)
        limit = READ_LIMITS[self.area]
        if not 1 <= self.quantity <= limit:
            raise malformed(f"Quantity must be between 1 and {limit}, found {self.quantity}")
        check_end(self.address, self.quantity)

    @property
    def fields(self) -> dict[str, Any]:
        """The range, for answers."""
        form = "coils" if self.area in BIT_AREAS else "registers"
        return {"address": self.address, "quantity": self.quantity, "format": form}

    def with_values(self, found: list[Any]) -> dict[str, Any]:
        """The range with its values, for answers."""
        typed = {} if self.kind is None else self.kind.decode(found)
        return {**self.fields, "values": found, **typed}

    async def read(self, device: RequestedDevice) -> list[Any]:
        """Reads the values: booleans, or integers 0 to 65535."""
        found: list[Any] = await device.ask(
            lambda client: getattr(client, f"read_{self.area}")(self.address, self.quantity)
        )
        return found


async def _connect(_: Given, device: RequestedDevice) -> Answer:
    answer = {"message": "Modbus server reachable", **device.target_fields}
    try:
        [register] = await device.ask(lambda client: client.read_holding_registers(0, 1))
    except ModbusException as error:
        answer["message"] += " (responded with exception)"
        return {**answer, "exception": exception_name(error)}
    return {**answer, "testRegister": register}


async def _read(given: Given, device: RequestedDevice) -> Answer:
    wanted = Range(given)
    found = await wanted.read(device)
    return {
        "functionCode": wanted.function,
        "functionName": FUNCTIONS[wanted.function].name.upper().replace(" ", "_"),
        **wanted.with_values(found),
    }


def _read_exception(given: Given, _: RequestedDevice, error: ModbusException) -> Answer:
    return {
        "success": False,
        "error": exception_text(error),
        "functionCode": given["functionCode"],
        "address": given["address"],
        "quantity": Range(given).quantity,
    }


TYPED_ANSWER_FIELDS: dict[str, Schema] = {
    "typed": {
        "type": "array",
        "description": "With `datatype`: the values, `null` where `typedErrors` has the reason",
    },
    "typedText": array_of(TEXT)
    | {"description": "The values as text; floats have the fewest digits that identify them"},
    "typedErrors": map_of(TEXT, "By index in `typed`: why the value is `null`"),
}

RANGE_PROPERTIES: dict[str, Schema] = {
    "address": ADDRESS_SCHEMA,
    "quantity": integer(1, READ_BITS),
    "format": {"enum": ["coils", "registers"]},
    "values": array_of({**REGISTER, "type": ["integer", "boolean"]}),
    **TYPED_ANSWER_FIELDS,
}

ENDPOINTS = (
    Endpoint(
        path="/api/modbus/connect",
        name="connect",
        summary="Check whether a device responds",
        description=(
            "Reads holding register 0. A Modbus exception also shows that the device is reachable."
        ),
        execute=_connect,
        has_rtt=False,
        properties={"message": TEXT, "testRegister": REGISTER, "exception": TEXT},
        optional=("testRegister", "exception"),
        examples={"A device on port 502": {"host": "plc.factory.local", "unitId": 1}},
        answer={"message": "Modbus server reachable", "testRegister": 42},
    ),
    Endpoint(
        path="/api/modbus/read",
        name="read",
        summary="Read coils, discrete inputs, holding or input registers",
        description=f"Functions 1 to 4. `values` are booleans, or register values 0 to {MAX_WORD}.",
        fields=RANGE,
        execute=_read,
        has_rtt=False,
        properties={"functionCode": FUNCTION_SCHEMA, "functionName": TEXT, **RANGE_PROPERTIES},
        optional=tuple(TYPED_ANSWER_FIELDS),
        examples={
            "Five registers": {**EXAMPLE, "functionCode": 3, "address": 100, "quantity": 5},
            "Two floats, low word first": {
                **EXAMPLE,
                "functionCode": 4,
                "address": 0,
                "datatype": "float32[2]",
                "byteOrder": "CDAB",
            },
        },
        answer={
            "functionCode": 3,
            "functionName": "READ_HOLDING_REGISTERS",
            "address": 100,
            "quantity": 5,
            "format": "registers",
            "values": [1234, 0, 65535, 42, 7],
        },
        on_exception=_read_exception,
    ),
)
