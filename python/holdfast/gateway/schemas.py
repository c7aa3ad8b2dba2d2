"""The JSON schemas of the gateway's errors, of its status, and of the data of its events."""

from __future__ import annotations

from typing import get_args

from holdfast.discovery.address_search import State
from holdfast.gateway.endpoints import tag_lists
from holdfast.gateway.endpoints.read import FUNCTION_SCHEMA, RANGE_PROPERTIES, TYPED_ANSWER_FIELDS
from holdfast.gateway.fields import ADDRESS_SCHEMA, UNIT_SCHEMA
from holdfast.net.addresses import LAST_PORT
from holdfast.net.http.schemas import (
    BOOLEAN,
    COUNT,
    NUMBER,
    TEXT,
    Schema,
    array_of,
    count,
    integer,
    map_of,
    object_of,
)
from holdfast.protocol import READ_BITS
from holdfast.types import AREAS

TARGET_SCHEMAS: dict[str, Schema] = {
    "host": TEXT,
    "port": integer(1, LAST_PORT),
    "unitId": UNIT_SCHEMA,
}
"""The fields of a device in answers."""

_QUANTITY = integer(1, READ_BITS)
_VALUE: Schema = {"type": ["integer", "boolean"]}
_AREA: Schema = {"enum": list(AREAS)}
_FORMAT: Schema = {"enum": ["coils", "registers"]}
_RANGES: Schema = {
    **array_of({**array_of(ADDRESS_SCHEMA), "minItems": 2, "maxItems": 2}),
    "description": "The first and the last address of each range",
}
_NOW: dict[str, Schema] = {
    "time": count("The end of the poll, in milliseconds since 1970"),
    "rtt": count("The duration of the poll in milliseconds"),
}
CODE: Schema = {**integer(0, 255), "description": "The code of a Modbus exception"}
_ASKED = {"functionCode": FUNCTION_SCHEMA, "address": ADDRESS_SCHEMA, "quantity": _QUANTITY}

_ERRORS: dict[str, Schema] = {
    "Error": object_of({"success": {"const": False}, "error": TEXT}),
    "ModbusException": object_of(
        {
            "success": {"const": False},
            "error": {**TEXT, "examples": ["Modbus exception: Illegal Data Address (code 0x2)"]},
            **TARGET_SCHEMAS,
            **_ASKED,
        },
        optional=(*TARGET_SCHEMAS, *_ASKED),
    ),
}
_STATUS = object_of(
    {
        "version": TEXT,
        "writes": BOOLEAN,
        "tokens": BOOLEAN,
        "allow": array_of(TEXT),
        "limits": object_of({"timeout": COUNT, "interval": COUNT}),
        "connections": count("Open connections to devices"),
        "keyPrefix": TEXT
        | {
            "description": "An `Idempotency-Key` with it is refused after the gateway has restarted"
        },
    }
)
_TYPED_CHANGE = object_of(
    {"index": COUNT, "value": {}, "text": TEXT, "error": TEXT}, optional=("error",)
)
_WATCHES: dict[str, Schema] = {
    "Values": object_of({**_NOW, **RANGE_PROPERTIES}, optional=tuple(TYPED_ANSWER_FIELDS)),
    "Change": object_of(
        {
            **_NOW,
            "changes": array_of(object_of({"address": ADDRESS_SCHEMA, "value": _VALUE})),
            "typed": array_of(_TYPED_CHANGE),
        },
        optional=("typed",),
    ),
    "Problem": object_of({**_NOW, "error": TEXT, "reason": TEXT, "code": CODE}, optional=("code",)),
}

_PAIR: Schema = {"type": "array", "minItems": 2, "maxItems": 2, "prefixItems": [COUNT, {}]}
_PROBLEM: dict[str, Schema] = {
    "error": {"type": ["string", "null"], "description": "Why the last poll failed"},
    "reason": TEXT,
    "code": CODE,
}
_STATES: dict[str, Schema] = {
    "values": {"type": "array", "description": "Registers or bits; the values of tags"},
    "texts": array_of(TEXT),
    "errors": map_of(TEXT),
    **_PROBLEM,
}
_RANGE = object_of(
    {"kind": {"const": "range"}, **_ASKED, "format": _FORMAT, **_STATES}, optional=tuple(_STATES)
)
_TAGS = object_of(
    {"kind": {"const": "tags"}, "tags": array_of(tag_lists.TAG), **_STATES},
    optional=(*_STATES, "tags"),
)
_CHANGES = {name: array_of(_PAIR) for name in ("values", "texts", "errors")}
_CHANGED_PART = object_of({"part": COUNT, **_CHANGES, **_PROBLEM}, optional=(*_CHANGES, *_PROBLEM))
_VIEWS: dict[str, Schema] = {
    "View": object_of(
        {
            **_NOW,
            "stream": {**BOOLEAN, "description": "Whether more events follow"},
            "parts": array_of({"oneOf": [_RANGE, _TAGS]}),
        }
    ),
    "ViewChange": object_of({**_NOW, "parts": array_of(_CHANGED_PART)}),
}

_FOUND: dict[str, Schema] = {
    "area": _AREA,
    "addresses": COUNT,
    "ranges": _RANGES,
    "notSearchedFrom": {
        "type": ["integer", "null"],
        "description": "From where only usual start addresses were read; `null` after the search "
        "of the area",
    },
}
_MAPPED_AREA = object_of(
    {
        **_FOUND,
        "state": {
            "enum": list(get_args(State)),
            "description": "`partly`: it ended early; `given_up`: the device can't read the area",
        },
        "absent": count("Addresses that do not exist"),
        "absentRanges": _RANGES,
        "notAsked": count("Addresses that were not read: unknown"),
        "failures": map_of(
            _RANGES,
            "By exception code, or `timeout`, `connection`, `invalid`: addresses whose reads "
            "failed, so that it is unknown whether they are valid",
        ),
        "givenUp": {"type": ["integer", "string", "null"]},
        "largest": count("The largest quantity that one read returned"),
        "requests": COUNT,
    }
)
_MAPS: dict[str, Schema] = {
    "Progress": object_of(
        {
            "at": count("Addresses done so far"),
            "total": COUNT,
            "requests": COUNT,
            "found": {
                **array_of(
                    object_of({"area": _AREA, "first": ADDRESS_SCHEMA, "last": ADDRESS_SCHEMA})
                ),
                "description": "The ranges whose ends were found since the last event",
            },
            "areas": array_of(object_of(_FOUND, optional=("ranges",))),
        }
    ),
    "Map": object_of(
        {
            "success": BOOLEAN,
            "error": {**TEXT, "description": "Why it ended early"},
            "reason": {**TEXT, "description": "The reason as a word"},
            "requests": COUNT,
            "seconds": NUMBER,
            "exact": BOOLEAN,
            "first": ADDRESS_SCHEMA,
            "last": ADDRESS_SCHEMA,
            "areas": array_of(_MAPPED_AREA),
        },
        optional=("error", "reason"),
    ),
}

SCHEMAS: dict[str, Schema] = {**_ERRORS, "Status": _STATUS, **_WATCHES, **_VIEWS, **_MAPS}
