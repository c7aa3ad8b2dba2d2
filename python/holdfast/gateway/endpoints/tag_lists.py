"""The operations for tag lists, and for values before they are written. They ask no device."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from holdfast.config.tag_files.read import parse_tags
from holdfast.gateway.endpoint import REGISTERS
from holdfast.gateway.endpoints import request_tags, typed
from holdfast.gateway.endpoints.read import TYPED_ANSWER_FIELDS
from holdfast.gateway.fields import BYTE_ORDER, DATATYPE, REGISTER, TYPED_VALUE_SCHEMA
from holdfast.net.http.fields import REQUIRED, Field
from holdfast.net.http.openapi import json_answer
from holdfast.net.http.operations import Operation, body_of
from holdfast.net.http.schemas import (
    BOOLEAN,
    COUNT,
    NUMBER,
    NUMBER_OR_NULL,
    TEXT,
    Schema,
    array,
    array_of,
    map_of,
    object_of,
)
from holdfast.protocol import WRITE_REGISTERS

if TYPE_CHECKING:
    from collections.abc import Sequence


_SCALE = object_of(
    {"from": {"anyOf": [TEXT, {"type": "object"}]}, "as": {"enum": ["factor", "exponent"]}}
) | {"description": "The register that contains the scale: a tag, or its place"}
TAG = object_of(
    {
        "name": TEXT,
        "area": TEXT,
        "address": {"type": "integer"},
        "count": {"type": "integer", "description": "Bits or registers"},
        "type": TEXT,
        "order": TEXT,
        "unit": TEXT,
        "scale": {"anyOf": [NUMBER, _SCALE]},
        "offset": NUMBER,
        "writable": BOOLEAN,
        "min": NUMBER_OR_NULL,
        "max": NUMBER_OR_NULL,
        "minText": TEXT,
        "maxText": TEXT,
        "states": map_of(TEXT),
        "description": TEXT,
    },
    optional=("scale", "offset", "min", "max", "minText", "maxText", "states", "description"),
)
_EXAMPLE = (
    "name,area,address,type,order,scale,offset,unit,writable\nsetpoint,hr,24,uint16,,0.1,,°C,true\n"
)

[_SETPOINT] = map(request_tags.described, parse_tags(_EXAMPLE, "tags", is_csv=True))

_TABLE = object_of(
    {
        "orders": array_of(TEXT),
        "rows": array_of(object_of({"type": TEXT, "texts": array_of(TEXT)})),
    }
)


def _valid(
    properties: dict[str, Schema], reply: dict[str, Any], *, optional: Sequence[str] = ()
) -> dict[str, Any]:
    """The answer to a valid request."""
    whole = object_of({"success": {"const": True}, **properties}, optional=optional)
    return json_answer("The request is valid", whole, {"success": True, **reply})


OPERATIONS: tuple[Operation[Any], ...] = (
    Operation(
        "POST",
        "/api/gateway/tags",
        "tags",
        "Check a tag list",
        lambda app, request, given: app.check(request, request_tags.parse, given),
        _valid({"tags": array_of(TAG)}, {"tags": [_SETPOINT]}),
        ("busy",),
        "Parses a tag list as the command line does, and returns its tags. An error names the "
        "line, the tag and the key.",
        body=body_of(request_tags.LIST, {"A list of one tag": {"tags": _EXAMPLE, "format": "csv"}}),
    ),
    Operation(
        "POST",
        "/api/gateway/tags/value",
        "tagValue",
        "Check a value of a tag before it is written",
        lambda app, request, given: app.check(request, request_tags.encode, given),
        _valid(
            {
                "tag": TAG,
                "form": {
                    "enum": ["coils", "registers", "mask"],
                    "description": "What to write; for `mask`, `values` are the AND and the OR "
                    "mask",
                },
                "values": array_of({"type": ["integer", "boolean"]}),
                "value": {"description": "The value as it is then read"},
                "text": TEXT,
            },
            {
                "tag": _SETPOINT,
                "form": "registers",
                "values": [215],
                "value": 21.5,
                "text": "21.5",
            },
        ),
        ("busy",),
        "Returns what a write has to send. Nothing is sent. A value that does not fit the type, "
        "the scale, `min` and `max` is refused, as are tags that are not `writable`.",
        body=body_of(
            (*request_tags.LIST, request_tags.NAME, request_tags.VALUE),
            {
                "A list of one tag": {
                    "tags": _EXAMPLE,
                    "format": "csv",
                    "name": "setpoint",
                    "value": "21.5",
                }
            },
        ),
    ),
    Operation(
        "POST",
        "/api/gateway/values",
        "values",
        "Check typed values before they are written",
        lambda app, request, given: app.check(request, typed.encode, given),
        _valid(
            {"values": REGISTERS, **TYPED_ANSWER_FIELDS},
            {"values": [0, 0x41AC], "typed": [21.5], "typedText": ["21.5"]},
            optional=("typedErrors",),
        ),
        ("busy",),
        "Returns the registers that hold the values, and the values as they are then read. Nothing "
        "is sent. A value that does not fit the type is refused.",
        body=body_of(
            (
                Field(
                    "values",
                    array(TYPED_VALUE_SCHEMA, WRITE_REGISTERS),
                    f"Values of the type, bytes in hex, for up to {WRITE_REGISTERS} registers",
                ),
                replace(DATATYPE, default=REQUIRED),
                BYTE_ORDER,
            ),
            {
                "A float, low word first": {
                    "values": [21.5],
                    "datatype": "float32",
                    "byteOrder": "CDAB",
                }
            },
        ),
    ),
    Operation(
        "POST",
        "/api/gateway/types",
        "types",
        "Show registers in every type and byte order",
        lambda app, request, given: app.check(request, typed.every, given),
        _valid({"tables": array_of(_TABLE)}, {"tables": typed.tables([0x41AC])}),
        ("busy",),
        "Returns tables of texts: a row for each type that the registers hold, a column for each "
        "byte order. With four registers, the second table has more orders of eight bytes.",
        body=body_of(
            (Field("registers", array(REGISTER, 4), "One to four registers"),),
            {"One register": {"registers": [0x41AC]}},
        ),
    ),
    Operation(
        "GET",
        "/api/gateway/profiles",
        "profiles",
        "List the profiles of the configuration",
        lambda app, _, __: app.profiles(),
        json_answer(
            "The profiles",
            object_of({"profiles": array_of(object_of({"name": TEXT, "tags": COUNT}))}),
            {"profiles": [{"name": "sdm630", "tags": 24}]},
        ),
    ),
)
