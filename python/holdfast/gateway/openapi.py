"""The OpenAPI document, generated from the endpoints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_args

from holdfast.gateway import listing, surveying, viewing, watching
from holdfast.gateway.endpoint import EXAMPLE, never
from holdfast.gateway.fields import ADDRESS_SCHEMA, UNIT_SCHEMA, Field, timeout
from holdfast.gateway.reading import FUNCTION_SCHEMA, TYPED
from holdfast.gateway.refusals import (
    ASKING,
    BODY,
    DEVICE,
    EVERYWHERE,
    FAILURE,
    QUERY,
    REFUSALS,
    WRITE,
)
from holdfast.net.addresses import LAST_PORT
from holdfast.protocol import READ_BITS
from holdfast.tools.discovery import State
from holdfast.types import AREAS
from holdfast.web.openapi import (
    DOCUMENT,
    PAGE,
    array_of,
    html_answer,
    integer,
    json_answer,
    object_of,
    ref,
    refusal_components,
    refused_by,
    stream_answer,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.gateway.endpoint import Operation
    from holdfast.gateway.settings import GatewayLimits, Settings
    from holdfast.web.openapi import Schema
    from holdfast.web.refusals import Refusal

STATUS = "/api/gateway"
FAILED = refused_by([FAILURE])
_DESCRIBED = (*EVERYWHERE, *ASKING, "unauthorized", *BODY, *DEVICE)


def document(version: str, endpoints: Iterable[Operation], settings: Settings) -> dict[str, Any]:
    """Returns the document of a gateway with these settings."""
    secured = bool(settings.tokens)
    limits = settings.limits
    paths: dict[str, Any] = {each.path: {"post": _endpoint(each, limits)} for each in endpoints}
    paths |= _streams(limits) | {STATUS: {"get": _status()}, **_local()}
    for path in paths.values():
        for operation in path.values():
            operation["security"] = [{"token": []}] if secured else []
            operation["responses"] |= _refusals("unauthorized") if secured else {}
    schemes = {"securitySchemes": {"token": {"type": "http", "scheme": "bearer"}}}
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "Holdfast gateway",
            "version": version,
            "summary": "Access to Modbus devices over HTTP.",
            "description": "Every response of a device has status 200; a Modbus exception has "
            "`success` false. A failed connection or a timeout has status 500. The header "
            "`Holdfast-Reason` has the reason of an error as a word. Addresses count from 0. "
            "`timeout` covers connecting, sending and receiving. "
            f"A body has at most {limits.body} bytes.",
        },
        "servers": [{"url": "/"}],
        "paths": paths | _documents(),
        "components": {
            "schemas": _schemas(),
            "responses": refusal_components((*REFUSALS.of(_DESCRIBED), FAILURE), _refused),
            **(schemes if secured else {}),
        },
    }


def _endpoint(endpoint: Operation, limits: GatewayLimits) -> dict[str, Any]:
    longest = round(1000 * limits.timeout)
    fields = (*endpoint.fields, timeout(min(endpoint.timeout, longest), longest))
    answer = {"success": {"const": True}, **_target(), **endpoint.properties}
    if endpoint.broadcast:
        answer["note"] = {"type": "string", "description": "Only for a broadcast"}
    whole = object_of(answer, optional=(*endpoint.optional, "note"))
    example = {"success": True, **endpoint.answer}
    return {
        "operationId": endpoint.name,
        "summary": endpoint.summary,
        "description": endpoint.description,
        "requestBody": _body(fields, endpoint.examples),
        "responses": {
            "200": json_answer(
                "The device responded", {"oneOf": [whole, ref("ModbusException")]}, example
            ),
            **_refusals(*BODY, *_of_device(endpoint)),
            **FAILED,
        },
    }


def _of_device(endpoint: Operation) -> tuple[str, ...]:
    return (*ASKING, *DEVICE, *(() if endpoint.writes is never else WRITE))


def _streams(limits: GatewayLimits) -> dict[str, Any]:
    return {
        surveying.PATH: {
            "post": {
                "operationId": "map",
                "summary": "Find the valid addresses of a device",
                "description": "Reads samples, and follows each range to both ends; with `exact` "
                "it reads every address. Nothing is written. Events: `progress` repeatedly, then "
                "`result`.",
                "requestBody": _body(
                    surveying.fields(limits),
                    {"Registers below 1000": {**EXAMPLE, "areas": list(AREAS[2:]), "last": 999}},
                ),
                "responses": {
                    "200": stream_answer(progress="Progress", result="Map"),
                    **_refusals(*BODY, *ASKING, *DEVICE),
                    **FAILED,
                },
            }
        },
        viewing.PATH: {"post": _view(limits)},
        watching.PATH: {
            "get": {
                "operationId": "watch",
                "summary": "Poll a range and stream changes",
                "description": "Events: `values` with all values, `change` with the changed "
                "values, `problem` for a Modbus exception or no response. Comments are heartbeats.",
                "parameters": [_parameter(field) for field in watching.fields(limits)],
                "responses": {
                    "200": stream_answer(values="Values", change="Change", problem="Problem"),
                    **_refusals(*QUERY, *ASKING, *DEVICE),
                    **FAILED,
                },
            }
        },
    }


def _view(limits: GatewayLimits) -> dict[str, Any]:
    parts: list[dict[str, Any]] = [
        {"functionCode": 3, "address": 0, "quantity": 10, "datatype": "float32"},
        {"tags": "tags:\n  level: {area: input_registers, address: 8, type: int16, unit: mm}\n"},
    ]
    return {
        "operationId": "view",
        "summary": "Poll several ranges and tag lists in one stream",
        "description": "Events: `view` with all values, then `change` for each poll with the "
        "changed values, as pairs of index and value. A part that can't be read has an `error` "
        "until it can. Comments are heartbeats.",
        "requestBody": _body(
            viewing.fields(limits), {"A range and tags": {**EXAMPLE, "parts": parts}}
        ),
        "responses": {
            "200": stream_answer(view="View", change="ViewChange"),
            **_refusals(*BODY, *ASKING, *DEVICE),
            **FAILED,
        },
    }


def _local() -> dict[str, Any]:
    """The operations that ask no device."""
    found: dict[str, Any] = {
        each.path: {
            "post": {
                "operationId": each.name,
                "summary": each.summary,
                "description": each.description,
                "requestBody": _body(each.fields, {each.example: each.request}),
                "responses": {
                    "200": json_answer(
                        "The request is valid",
                        object_of(
                            {"success": {"const": True}, **each.properties}, optional=each.optional
                        ),
                        {"success": True, **each.reply},
                    ),
                    **_refusals(*BODY, *ASKING, "busy"),
                },
            }
        }
        for each in listing.ENDPOINTS
    }
    profile = object_of({"name": {"type": "string"}, "tags": COUNT})
    found[listing.PROFILES] = {
        "get": {
            "operationId": "profiles",
            "summary": "List the profiles of the configuration",
            "responses": {
                "200": json_answer(
                    "The profiles",
                    object_of({"profiles": array_of(profile)}),
                    {"profiles": [{"name": "sdm630", "tags": 24}]},
                ),
                **_refusals(*ASKING),
            },
        }
    }
    return found


def _status() -> dict[str, Any]:
    return {
        "operationId": "status",
        "summary": "Get the settings of this gateway",
        "responses": {
            "200": json_answer(
                "The version, settings and limits",
                ref("Status"),
                {
                    "version": "0.1.0",
                    "writes": False,
                    "tokens": False,
                    "allow": ["10.0.0.0/8:502"],
                    "limits": {"timeout": 60000, "interval": 100},
                    "connections": 2,
                },
            ),
            **_refusals(*ASKING),
        },
    }


def _documents() -> dict[str, Any]:
    """The operations for the OpenAPI document, its page, and the console."""
    whole = json_answer("The OpenAPI 3.1 document", {"type": "object"})
    return {
        path: {
            "get": {
                "operationId": name,
                "summary": summary,
                "security": [],
                "responses": {"200": answer, **_refusals()},
            }
        }
        for path, name, summary, answer in (
            (DOCUMENT, "openapi", "Get this document", whole),
            (PAGE, "docs", "Get this document as a web page", html_answer()),
            ("/", "console", "Open the console in a browser", html_answer()),
        )
    }


COUNT: Schema = {"type": "integer", "minimum": 0}
VALUE: Schema = {"type": ["integer", "boolean"]}
AREA: Schema = {"enum": list(AREAS)}
RANGES: Schema = {
    **array_of({**array_of(ADDRESS_SCHEMA), "minItems": 2, "maxItems": 2}),
    "description": "The first and the last address of each range",
}
NOW: dict[str, Schema] = {
    "time": {**COUNT, "description": "Milliseconds since 1970"},
    "rtt": COUNT,
}


def _schemas() -> dict[str, Schema]:
    """The schemas of errors, of the status, and of the data of events."""
    said: dict[str, Schema] = {"success": {"const": False}, "error": {"type": "string"}}
    about = {
        "functionCode": FUNCTION_SCHEMA,
        "address": ADDRESS_SCHEMA,
        "quantity": integer(1, READ_BITS),
    }
    return {
        "Error": object_of(said),
        "ModbusException": object_of(
            {
                "success": {"const": False},
                "error": {
                    "type": "string",
                    "examples": ["Modbus exception: Illegal Data Address (code 0x2)"],
                },
                **_target(),
                **about,
            },
            optional=(*_target(), *about),
        ),
        "Status": object_of(
            {
                "version": {"type": "string"},
                "writes": {"type": "boolean"},
                "tokens": {"type": "boolean"},
                "allow": array_of({"type": "string"}),
                "limits": object_of({"timeout": COUNT, "interval": COUNT}),
                "connections": {**COUNT, "description": "Open connections to devices"},
            }
        ),
        **_schemas_of_watches(),
        **_schemas_of_views(),
        **_schemas_of_maps(),
    }


def _schemas_of_watches() -> dict[str, Schema]:
    typed: dict[str, Schema] = {"index": COUNT, "value": {}, "text": {"type": "string"}}
    return {
        "Values": object_of(
            {
                **NOW,
                "address": ADDRESS_SCHEMA,
                "quantity": integer(1, READ_BITS),
                "format": {"enum": ["coils", "registers"]},
                "values": array_of(VALUE),
                **TYPED,
            },
            optional=tuple(TYPED),
        ),
        "Change": object_of(
            {
                **NOW,
                "changes": array_of(object_of({"address": ADDRESS_SCHEMA, "value": VALUE})),
                "typed": array_of(object_of(typed)),
            },
            optional=("typed",),
        ),
        "Problem": object_of({**NOW, "error": {"type": "string"}, "reason": {"type": "string"}}),
    }


def _schemas_of_views() -> dict[str, Schema]:
    pair = {"type": "array", "minItems": 2, "maxItems": 2, "prefixItems": [COUNT, {}]}
    problem: dict[str, Schema] = {
        "error": {"type": ["string", "null"], "description": "Why the last poll failed"},
        "reason": {"type": "string"},
    }
    states: dict[str, Schema] = {
        "values": {"type": "array", "description": "Registers or bits; the values of tags"},
        "texts": array_of({"type": "string"}),
        "errors": {"type": "object", "additionalProperties": {"type": "string"}},
        **problem,
    }
    ranged: dict[str, Schema] = {
        "kind": {"const": "range"},
        "functionCode": FUNCTION_SCHEMA,
        "address": ADDRESS_SCHEMA,
        "quantity": integer(1, READ_BITS),
        "format": {"enum": ["coils", "registers"]},
    }
    tagged: dict[str, Schema] = {"kind": {"const": "tags"}, "tags": array_of(listing.TAG)}
    changes = {name: array_of(pair) for name in ("values", "texts", "errors")}
    return {
        "View": object_of(
            {
                **NOW,
                "stream": {"type": "boolean", "description": "Whether more events follow"},
                "parts": array_of(
                    {
                        "oneOf": [
                            object_of({**ranged, **states}, optional=tuple(states)),
                            object_of({**tagged, **states}, optional=(*states, "tags")),
                        ]
                    }
                ),
            }
        ),
        "ViewChange": object_of(
            {
                **NOW,
                "parts": array_of(
                    object_of({"part": COUNT, **changes, **problem}, optional=(*changes, *problem))
                ),
            }
        ),
    }


def _schemas_of_maps() -> dict[str, Schema]:
    found = {
        "area": AREA,
        "addresses": COUNT,
        "ranges": RANGES,
        "notSearchedFrom": {
            "type": ["integer", "null"],
            "description": "From where only usual start addresses were read; `null` after the "
            "search of the area",
        },
    }
    finding = object_of({"area": AREA, "first": ADDRESS_SCHEMA, "last": ADDRESS_SCHEMA})
    failures = {
        "type": "object",
        "additionalProperties": RANGES,
        "description": "By exception code, or `timeout`, `connection`, `invalid`: addresses whose "
        "reads failed, so that it is unknown whether they are valid",
    }
    return {
        "Progress": object_of(
            {
                "at": {**COUNT, "description": "Addresses done so far"},
                "total": COUNT,
                "requests": COUNT,
                "found": {
                    **array_of(finding),
                    "description": "The ranges whose ends were found since the last event",
                },
                "areas": array_of(object_of(found, optional=("ranges",))),
            }
        ),
        "Map": object_of(
            {
                "success": {"type": "boolean"},
                "error": {"type": "string", "description": "Why it ended early"},
                "reason": {"type": "string", "description": "The reason as a word"},
                "requests": COUNT,
                "seconds": {"type": "number"},
                "exact": {"type": "boolean"},
                "step": {
                    "type": ["integer", "null"],
                    "description": "The largest distance of two samples. Addresses where ranges "
                    "often begin were read too. `null` if every address was read",
                },
                "first": ADDRESS_SCHEMA,
                "last": ADDRESS_SCHEMA,
                "areas": array_of(
                    object_of(
                        {
                            **found,
                            "state": {
                                "enum": list(get_args(State)),
                                "description": "`partly`: it ended early; `given_up`: the device "
                                "can't read the area",
                            },
                            "absent": {**COUNT, "description": "Addresses that do not exist"},
                            "absentRanges": RANGES,
                            "notAsked": {
                                **COUNT,
                                "description": "Addresses that were not read: unknown",
                            },
                            "failures": failures,
                            "givenUp": {"type": ["integer", "string", "null"]},
                            "largest": {
                                **COUNT,
                                "description": "The largest quantity that one read returned",
                            },
                            "requests": COUNT,
                        }
                    )
                ),
            },
            optional=("error", "reason"),
        ),
    }


def _target() -> dict[str, Schema]:
    return {"host": {"type": "string"}, "port": integer(1, LAST_PORT), "unitId": UNIT_SCHEMA}


def _body(fields: Sequence[Field], examples: dict[str, dict[str, Any]]) -> dict[str, Any]:
    schema = {
        "type": "object",
        "required": [field.name for field in fields if field.required],
        "properties": {field.name: field.described for field in fields},
        "additionalProperties": False,
    }
    shown = {
        f"example{number}": {"summary": title, "value": value}
        for number, (title, value) in enumerate(examples.items(), start=1)
    }
    content = {"application/json": {"schema": schema, "examples": shown}}
    return {"required": True, "content": content}


def _parameter(field: Field) -> dict[str, Any]:
    examples = {**EXAMPLE, "functionCode": 3, "address": 0, "quantity": 10, "datatype": "float32"}
    schema = {key: value for key, value in field.described.items() if key != "description"}
    if schema["type"] == "integer" and "enum" in schema:
        allowed = schema["enum"]
        schema = integer(min(allowed), max(allowed))
    return {
        "name": field.name,
        "in": "query",
        "required": field.required,
        "description": field.text,
        "schema": schema,
        "example": examples.get(field.name, field.default),
    }


def _refusals(*reasons: str) -> dict[str, Any]:
    """The responses of an operation for these reasons."""
    return refused_by(REFUSALS.of((*reasons, *EVERYWHERE)))


def _refused(row: Refusal) -> dict[str, Any]:
    """The response to a refused or failed request."""
    said = json_answer(row.means, ref("Error"), {"success": False, "error": row.example})
    reason = {"schema": {"enum": list(row.reasons)}, "description": "The reason as a word"}
    return {**said, "headers": {"Holdfast-Reason": reason}}
