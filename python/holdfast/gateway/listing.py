"""The endpoints for tag lists, and for values before they are written. They ask no device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from holdfast.gateway import tagging, typed
from holdfast.gateway.endpoint import REGISTERS
from holdfast.gateway.fields import BYTE_ORDER, DATATYPE, TYPED_SCHEMA
from holdfast.gateway.reading import TYPED
from holdfast.protocol import WRITE_REGISTERS
from holdfast.web.fields import REQUIRED, Field
from holdfast.web.schemas import array

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from holdfast.gateway.endpoint import Answer, Given
    from holdfast.tags import TagList
    from holdfast.web.schemas import Schema


@dataclass(frozen=True)
class Local:
    """An endpoint that asks no device."""

    path: str
    name: str
    summary: str
    description: str
    fields: tuple[Field, ...]
    answer: Callable[[Given, Mapping[str, TagList]], Awaitable[Answer]]
    properties: dict[str, Schema]
    """The schemas of the answer's fields, without `success`."""
    example: str
    """The name of an example of a request, and of its answer."""
    request: dict[str, Any]
    reply: dict[str, Any]
    optional: tuple[str, ...] = ()
    """The properties that an answer may not have."""


def profiles(known: Mapping[str, TagList]) -> Answer:
    """The names of the profiles, and how many tags they have."""
    return {"profiles": [{"name": name, "tags": len(tags)} for name, tags in known.items()]}


NUMBER = {"type": ["number", "null"]}
TEXT = {"type": "string"}
TAG: Schema = {
    "type": "object",
    "required": ["name", "area", "address", "count", "type", "order", "unit", "writable"],
    "properties": {
        "name": TEXT,
        "area": TEXT,
        "address": {"type": "integer"},
        "count": {"type": "integer", "description": "Bits or registers"},
        "type": TEXT,
        "order": TEXT,
        "unit": TEXT,
        "scale": {
            "anyOf": [
                {"type": "number"},
                {
                    "type": "object",
                    "description": "The register that contains the scale: a tag, or its place",
                    "required": ["from", "as"],
                    "properties": {
                        "from": {"anyOf": [TEXT, {"type": "object"}]},
                        "as": {"enum": ["factor", "exponent"]},
                    },
                    "additionalProperties": False,
                },
            ]
        },
        "offset": {"type": "number"},
        "writable": {"type": "boolean"},
        "min": NUMBER,
        "max": NUMBER,
        "states": {"type": "object", "additionalProperties": TEXT},
        "description": TEXT,
    },
    "additionalProperties": False,
}
_EXAMPLE = (
    "name,area,address,type,order,scale,offset,unit,writable\nsetpoint,hr,24,uint16,,0.1,,°C,true\n"
)

_SETPOINT: dict[str, Any] = {
    "name": "setpoint",
    "area": "holding_registers",
    "address": 24,
    "count": 1,
    "type": "uint16",
    "order": "ABCD",
    "unit": "°C",
    "scale": 0.1,
    "offset": 0.0,
    "writable": True,
    "min": None,
    "max": None,
    "states": {},
    "description": "",
}

ENDPOINTS = (
    Local(
        "/api/gateway/tags",
        "tags",
        "Check a tag list",
        "Parses a tag list as the command line does, and returns its tags. An error names the "
        "line, the tag and the key.",
        tagging.LIST,
        tagging.parse,
        {"tags": {"type": "array", "items": TAG}},
        "A list of one tag",
        {"tags": _EXAMPLE, "format": "csv"},
        {"tags": [_SETPOINT]},
    ),
    Local(
        "/api/gateway/tags/value",
        "tagValue",
        "Check a value of a tag before it is written",
        "Returns what a write has to send. Nothing is sent. A value that does not fit the type, "
        "the scale, `min` and `max` is refused, as are tags that are not `writable`.",
        (*tagging.LIST, tagging.NAME, tagging.VALUE),
        tagging.encode,
        {
            "tag": TAG,
            "form": {
                "enum": ["coils", "registers", "mask"],
                "description": "What to write; for `mask`, `values` are the AND and the OR mask",
            },
            "values": {"type": "array", "items": {"type": ["integer", "boolean"]}},
            "value": {"description": "The value as it is then read"},
            "text": TEXT,
        },
        "A list of one tag",
        {"tags": _EXAMPLE, "format": "csv", "name": "setpoint", "value": "21.5"},
        {
            "tag": _SETPOINT,
            "form": "registers",
            "values": [215],
            "value": 21.5,
            "text": "21.5",
        },
    ),
    Local(
        "/api/gateway/values",
        "values",
        "Check typed values before they are written",
        "Returns the registers that hold the values, and the values as they are then read. Nothing "
        "is sent. A value that does not fit the type is refused.",
        (
            Field(
                "values",
                array(TYPED_SCHEMA, WRITE_REGISTERS),
                f"Values of the type, bytes in hex, for up to {WRITE_REGISTERS} registers",
            ),
            replace(DATATYPE, default=REQUIRED),
            BYTE_ORDER,
        ),
        typed.encode,
        {"values": REGISTERS, **TYPED},
        "A float, low word first",
        {"values": [21.5], "datatype": "float32", "byteOrder": "CDAB"},
        {"values": [0, 0x41AC], "typed": [21.5], "typedText": ["21.5"]},
        optional=("typedErrors",),
    ),
)
