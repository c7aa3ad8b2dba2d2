"""The fields that requests of several operations have."""

from __future__ import annotations

from holdfast.net.addresses import LAST_PORT
from holdfast.net.hosts import is_host
from holdfast.net.http.fields import Field, malformed
from holdfast.net.http.schemas import Schema, array, integer
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_UNIT, MAX_WORD, TLS_PORT
from holdfast.protocol import PORT as STANDARD_PORT
from holdfast.types import AREAS, TRANSPORTS
from holdfast.values.orders import DEFAULT_ORDER

_HOST = r"^(\[[0-9A-Fa-f:.]{2,45}\]|[0-9A-Fa-f:.]{2,45}|[A-Za-z0-9_]([A-Za-z0-9._-]{0,252}))$"


REGISTER = integer(0, MAX_WORD)
ADDRESS_SCHEMA = integer(0, LAST_ADDRESS)
UNIT_SCHEMA = integer(0, MAX_UNIT)
BIT: Schema = {"enum": [False, True, 0, 1]}
TYPED_VALUE_SCHEMA: Schema = {"type": ["integer", "number", "string", "boolean"]}
"""A value of the type that `datatype` names."""
TYPE_NAME_SCHEMA: Schema = {"type": "string", "minLength": 1, "maxLength": 32}
ORDER: Schema = {"type": "string", "pattern": "^([A-D]{4}|[A-H]{8})$"}


NAME_OR_ADDRESS = "a name or an IP address; the port is a field of its own"

HOST = Field(
    "host",
    {"type": "string", "maxLength": 253, "pattern": _HOST},
    "Name or IP address of the device; it must be in the egress list",
    allowed=NAME_OR_ADDRESS,
    fits=is_host,
    example="plc.factory.local",
)
PORT = Field(
    "port",
    integer(1, LAST_PORT),
    f"Port; default {STANDARD_PORT}, {TLS_PORT} with `tls`",
    None,
    example=STANDARD_PORT,
)
UNIT = Field("unitId", UNIT_SCHEMA, "Unit id (slave address)", 1)
TRANSPORT = Field(
    "transport",
    {"type": "string", "enum": list(TRANSPORTS)},
    "Transport; `tls` is Modbus/TCP Security (Modbus TCP over TLS)",
    "tcp",
)
SERVER_NAME = Field(
    "serverName",
    {"type": "string", "maxLength": 253, "pattern": _HOST},
    "With `tls`: the name or IP address in the device's certificate; default `host`",
    None,
    allowed="a name or an IP address",
    fits=is_host,
)
ADDRESS = Field("address", ADDRESS_SCHEMA, "The first address, from 0", example=0)
DATATYPE = Field(
    "datatype",
    TYPE_NAME_SCHEMA,
    "Type of the values: `int16`, `uint32`, `float32`, `bcd16`, `bit:3`, `string:20`, `bytes:4`, "
    "`bool`, or an array such as `float32[10]`",
    None,
    allowed="a type such as int16, float32, bcd16, bit:3, string:20 or float32[10]",
    example="float32",
)
BYTE_ORDER = Field(
    "byteOrder",
    ORDER,
    "Byte order: `ABCD`, `CDAB`, `BADC`, `DCBA`, or eight letters for eight bytes",
    DEFAULT_ORDER,
    allowed="ABCD, CDAB, BADC, DCBA, or eight letters A to H",
)
AREA_LIST = Field(
    "areas",
    array({"type": "string", "enum": list(AREAS)}, len(AREAS)) | {"uniqueItems": True},
    "The areas to map; default all four",
    None,
)


TIMEOUT_MS = 10_000
WRITE_TIMEOUT_MS = 5_000
POLL_TIMEOUT_MS = 5_000
MAP_READ_TIMEOUT_MS = 2_000
"""The timeouts of requests that name none."""


def check_end(address: int, count: int) -> None:
    """Raises `BadRequest` for a range that goes beyond the last address."""
    if address + count > ADDRESSES:
        raise malformed(f"{count} from address {address}: the last address is {LAST_ADDRESS}")


def max_streams(text: str) -> Field:
    """The field for the most streams of the client's address."""
    return Field("maxStreams", integer(1, 64), text, None)


def timeout(default: int, longest: int, text: str = "Timeout of the request in ms") -> Field:
    """The field for a timeout in milliseconds."""
    return Field("timeout", integer(1, longest), text, default)
