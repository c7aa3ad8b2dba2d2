"""The fields of requests. One definition serves JSON, queries and the OpenAPI document.

Nothing is converted: an integer has no fraction or exponent. Unknown fields are refused, so that a
misspelled field never falls back to its default.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import msgspec

from holdfast.net.addresses import LAST_PORT, address_in
from holdfast.protocol import LAST_ADDRESS, MAX_UNIT, MAX_WORD, TLS_PORT
from holdfast.protocol import PORT as STANDARD_PORT
from holdfast.types import AREAS, TRANSPORTS
from holdfast.web.openapi import Schema as Schema
from holdfast.web.openapi import integer as integer
from holdfast.web.requests import BadRequest, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

REQUIRED: Any = object()
"""The default of a required field."""

MAX_PARAMETERS = 32

_HOST = r"^(\[[0-9A-Fa-f:.]{2,45}\]|[0-9A-Fa-f:.]{2,45}|[A-Za-z0-9_]([A-Za-z0-9._-]{0,252}))$"


@dataclass(frozen=True)
class Field:
    """A field. It is required if `default` is `REQUIRED`; `None` means optional without default."""

    name: str
    schema: Schema
    text: str
    default: Any = REQUIRED
    refusal: Callable[[Any], str] | None = None
    """Returns the error message for a wrong value; `None` for the default message."""
    allowed: str = ""
    """The allowed values for error messages; empty to use the schema."""
    fits: Callable[[Any], bool] = lambda _: True
    """Additional check of a value that fits the schema."""

    def check(self, value: Any) -> Any:
        """Returns the value if it is valid. Raises `BadRequest`."""
        flaw = _flaw(value, self.schema)
        if flaw is None and self.fits(value):
            return value
        if self.allowed:
            flaw = f" is {told(value)}, allowed: {self.allowed}"
        raise malformed(f"{self.name}{flaw}" if self.refusal is None else self.refusal(value))

    def read(self, text: str) -> Any:
        """Parses and checks a value from a query. Raises `BadRequest`."""
        kind = self.schema["type"]
        if kind == "integer" and re.fullmatch("(0|[1-9][0-9]{0,9})", text):
            return self.check(int(text))
        return self.check(text)

    @property
    def required(self) -> bool:
        """Whether the field is required."""
        return self.default is REQUIRED

    @property
    def described(self) -> Schema:
        """The schema with the description and the default."""
        optional = {} if self.required or self.default is None else {"default": self.default}
        return {**self.schema, **optional, "description": self.text}


def array(items: Schema, most: int) -> Schema:
    """The schema of an array with 1 to `most` elements."""
    return {"type": "array", "minItems": 1, "maxItems": most, "items": items}


REGISTER = integer(0, MAX_WORD)
ADDRESS_SCHEMA = integer(0, LAST_ADDRESS)
UNIT_SCHEMA = integer(0, MAX_UNIT)
BIT: Schema = {"enum": [False, True, 0, 1]}
TYPED_SCHEMA: Schema = {"type": ["integer", "number", "string", "boolean"]}
"""A value of the type that `datatype` names."""
TEXT: Schema = {"type": "string", "minLength": 1, "maxLength": 32}
ORDER: Schema = {"type": "string", "pattern": "^([A-D]{4}|[A-H]{8})$"}


def is_host(text: str) -> bool:
    """Returns whether text is an IP address or a possible name.

    A name must not end in a numeric label, because resolvers parse it as an IPv4 address.
    """
    if address_in(text) is not None:
        return True
    last = text.removesuffix(".").rpartition(".")[2]
    return ":" not in text and re.fullmatch("[0-9]*|0[xX][0-9a-fA-F]*", last) is None


NAME_OR_ADDRESS = "a name or an IP address; the port is a field of its own"

HOST = Field(
    "host",
    {"type": "string", "maxLength": 253, "pattern": _HOST},
    "Name or IP address of the device; it must be in the egress list",
    allowed=NAME_OR_ADDRESS,
    fits=is_host,
)
PORT = Field(
    "port", integer(1, LAST_PORT), f"Port; default {STANDARD_PORT}, {TLS_PORT} with `tls`", None
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
ADDRESS = Field("address", ADDRESS_SCHEMA, "The first address, from 0")
DATATYPE = Field(
    "datatype",
    TEXT,
    "Type of the values: `int16`, `uint32`, `float32`, `bcd16`, `bit:3`, `string:20`, `bytes:4`, "
    "`bool`, or an array such as `float32[10]`",
    None,
    allowed="a type such as int16, float32, bcd16, bit:3, string:20 or float32[10]",
)
BYTE_ORDER = Field(
    "byteOrder",
    ORDER,
    "Byte order: `ABCD`, `CDAB`, `BADC`, `DCBA`, or eight letters for eight bytes",
    "ABCD",
    allowed="ABCD, CDAB, BADC, DCBA, or eight letters A to H",
)
AREA_LIST = Field(
    "areas",
    {
        "type": "array",
        "minItems": 1,
        "maxItems": len(AREAS),
        "uniqueItems": True,
        "items": {"type": "string", "enum": list(AREAS)},
    },
    "The areas to map; default all four",
    None,
)


def timeout(default: int, longest: int, text: str = "Timeout of the request in ms") -> Field:
    """The field for a timeout in milliseconds."""
    return Field("timeout", integer(1, longest), text, default)


def with_default(field: Field, default: Any) -> Field:
    """Returns the field with another default."""
    return replace(field, default=default)


class NotJson(BadRequest):
    """A body is not JSON."""


def from_json(body: bytes, fields: Sequence[Field]) -> dict[str, Any]:
    """Parses the fields of a JSON object and fills in defaults. Raises `BadRequest`."""
    given = decoded(body)
    if not isinstance(given, dict):
        raise malformed("the body is not a JSON object")
    return filled(given, fields)


def decoded(body: bytes) -> Any:
    """Parses JSON. Raises `NotJson`, and `BadRequest` for a duplicate name."""
    try:
        given = msgspec.json.decode(body)
        json.loads(body, object_pairs_hook=_without_twins)
    except (msgspec.MsgspecError, RecursionError, UnicodeError, ValueError) as error:
        raise NotJson("malformed", f"the body is not JSON: {str(error)[:100]}") from None
    return given


def _without_twins(pairs: list[tuple[str, Any]]) -> None:
    """Raises `BadRequest` for a duplicate name in an object."""
    seen: set[str] = set()
    for name, _ in pairs:
        if name in seen:
            raise malformed(f"{shown(name)} is given more than once")
        seen.add(name)


def from_query(query: bytes, fields: Sequence[Field]) -> dict[str, Any]:
    """Parses the fields of a query and fills in defaults. Raises `BadRequest`."""
    try:
        pairs = parse_qsl(
            query.decode("latin-1"), keep_blank_values=True, max_num_fields=MAX_PARAMETERS
        )
    except ValueError:
        raise malformed(f"more than {MAX_PARAMETERS} parameters") from None
    known = {field.name: field for field in fields}
    given: dict[str, Any] = {}
    for name, text in pairs:
        if name in given:
            raise malformed(f"{name} is given more than once")
        given[name] = known[name].read(text) if name in known else text
    return filled(given, fields)


def malformed(detail: str) -> BadRequest:
    """Creates the error for a malformed request."""
    return BadRequest("malformed", detail)


def filled(given: Mapping[str, Any], fields: Sequence[Field]) -> dict[str, Any]:
    """Checks the fields of an object and fills in defaults. Raises `BadRequest`."""
    missing = [field.name for field in fields if field.required]
    missing = [name for name in missing if name not in given]
    if missing:
        raise malformed(f"Missing required parameter{'s'[: len(missing) > 1]}: {listed(missing)}")
    names = [field.name for field in fields]
    for name in given:
        if name not in names:
            raise malformed(f"{shown(name)} is not a parameter, allowed: {', '.join(names)}")
    return {
        field.name: field.check(given[field.name]) if field.name in given else field.default
        for field in fields
    }


def _flaw(value: Any, schema: Schema) -> str | None:
    """Returns the error message after the value's name; `None` for a valid value."""
    kind = schema.get("type")
    if kind == "array":
        return _flaw_of_array(value, schema)
    if "enum" in schema:
        allowed = schema["enum"]
        fits = any(type(value) is type(each) and value == each for each in allowed)
        return None if fits else f" is {told(value)}, allowed: {_words(allowed)}"
    if kind == "integer":
        least, most = schema["minimum"], schema["maximum"]
        fits = type(value) is int and least <= value <= most
        return None if fits else f" is {told(value)}, allowed: an integer {least} to {most}"
    if kind == "boolean":
        return None if type(value) is bool else f" is {told(value)}, allowed: true and false"
    if kind != "string":
        return None
    fits = isinstance(value, str) and re.fullmatch(schema.get("pattern", ".*"), value) is not None
    least, most = schema.get("minLength", 1), schema.get("maxLength", 8)
    long = isinstance(value, str) and not least <= len(value) <= most
    return f" is {told(value)}, which is not valid" if long or not fits else None


def _flaw_of_array(value: Any, schema: Schema) -> str | None:
    if not isinstance(value, list):
        return f" is {told(value)}, allowed: an array"
    least, most = schema["minItems"], schema["maxItems"]
    if not least <= len(value) <= most:
        return f" has {len(value)} elements, allowed: {least} to {most}"
    if schema.get("uniqueItems") and any(value.count(each) > 1 for each in value):
        return " has duplicate elements"
    for index, item in enumerate(value):
        flaw = _flaw(item, schema["items"])
        if flaw is not None:
            return f"[{index}]{flaw}"
    return None


def told(value: Any) -> str:
    """Formats an untrusted value, cut to a limited length."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "an array"
    text = msgspec.json.encode(value).decode() if type(value) is not int else str(value)[:40]
    return text[:40]


def _words(allowed: Sequence[Any]) -> str:
    return ", ".join(each if isinstance(each, str) else told(each) for each in allowed)


def listed(entries: Iterable[object]) -> str:
    """Joins entries: `5, 6 and 15`."""
    *most, last = map(str, entries)
    return f"{', '.join(most)} and {last}" if most else last
