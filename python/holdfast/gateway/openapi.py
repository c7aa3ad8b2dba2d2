"""The OpenAPI document, made from what the endpoints say of themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.gateway import surveying, watching
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
    """The document of a gateway with these settings."""
    secured = bool(settings.tokens)
    limits = settings.limits
    paths: dict[str, Any] = {each.path: {"post": _endpoint(each, limits)} for each in endpoints}
    paths |= _streams(limits) | {STATUS: {"get": _status()}}
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
            "summary": "Modbus devices over HTTP.",
            "description": "Status 200 is for every reply that a device gave, a Modbus exception "
            "among them, with `success` false then; 500 is for no connection and for no reply in "
            "time. The header `Holdfast-Reason` has the reason of an error in a word. Addresses "
            "count from 0. `timeout` covers connecting, sending and receiving. "
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
        answer["note"] = {"type": "string", "description": "Of a broadcast: nobody confirms it"}
    whole = object_of(answer, optional=(*endpoint.optional, "note"))
    example = {"success": True, **endpoint.answer}
    return {
        "operationId": endpoint.name,
        "summary": endpoint.summary,
        "description": endpoint.description,
        "requestBody": _body(fields, endpoint.examples),
        "responses": {
            "200": json_answer(
                "What the device answered", {"oneOf": [whole, ref("ModbusException")]}, example
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
                "summary": "Find out which addresses a device has",
                "description": "By reading; nothing is written. Events: `progress` again and "
                "again, then `result`. Samples are read, and ranges followed from there; with "
                "`exact` every address is read.",
                "requestBody": _body(
                    surveying.fields(limits),
                    {"Registers below 1000": {**EXAMPLE, "areas": list(AREAS[2:]), "last": 999}},
                ),
                "responses": {
                    "200": _stream(progress="Progress", result="Map"),
                    **_refusals(*BODY, *ASKING, *DEVICE),
                    **FAILED,
                },
            }
        },
        watching.PATH: {
            "get": {
                "operationId": "watch",
                "summary": "Poll a range, and send what changes",
                "description": "Events: `values` with everything, `change` with what is other than "
                "before, `problem` when there is no reply. Comments are signs of life.",
                "parameters": [_parameter(field) for field in watching.fields(limits)],
                "responses": {
                    "200": _stream(values="Values", change="Change", problem="Problem"),
                    **_refusals(*QUERY, *ASKING, *DEVICE),
                    **FAILED,
                },
            }
        },
    }


def _status() -> dict[str, Any]:
    return {
        "operationId": "status",
        "summary": "What this gateway may do",
        "responses": {
            "200": json_answer(
                "Its version, and its limits",
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
    """The document itself, as JSON and as a page, and the console."""
    whole = json_answer("OpenAPI 3.1", {"type": "object"})
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
            (DOCUMENT, "openapi", "This document", whole),
            (PAGE, "docs", "This document as a page", html_answer()),
            ("/", "console", "The console, for a browser", html_answer()),
        )
    }


COUNT: Schema = {"type": "integer", "minimum": 0}
VALUE: Schema = {"type": ["integer", "boolean"]}
AREA: Schema = {"enum": list(AREAS)}
RANGES: Schema = {
    **array_of({**array_of(ADDRESS_SCHEMA), "minItems": 2, "maxItems": 2}),
    "description": "First and last addresses",
}
NOW: dict[str, Schema] = {
    "time": {**COUNT, "description": "Milliseconds since 1970"},
    "rtt": COUNT,
}


def _schemas() -> dict[str, Schema]:
    """Schemas that are named: errors, the status, and the data of events."""
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
                "connections": {**COUNT, "description": "Devices that it has a connection to"},
            }
        ),
        **_schemas_of_watches(),
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


def _schemas_of_maps() -> dict[str, Schema]:
    found = {"area": AREA, "addresses": COUNT, "ranges": RANGES}
    failures = {
        "type": "object",
        "additionalProperties": RANGES,
        "description": "By exception code, or `timeout`, `connection`, `invalid`: addresses that "
        "are neither there nor outside",
    }
    return {
        "Progress": object_of(
            {
                "at": {**COUNT, "description": "Addresses that were dealt with"},
                "total": COUNT,
                "requests": COUNT,
                "areas": array_of(object_of(found, optional=("ranges",))),
            }
        ),
        "Map": object_of(
            {
                "success": {"type": "boolean"},
                "error": {"type": "string", "description": "Why it ended early"},
                "reason": {"type": "string", "description": "The same in a word"},
                "requests": COUNT,
                "seconds": {"type": "number"},
                "exact": {"type": "boolean"},
                "step": {
                    "type": ["integer", "null"],
                    "description": "Samples were read at least every so many addresses, and where "
                    "ranges like to begin; `null` if every address was",
                },
                "first": ADDRESS_SCHEMA,
                "last": ADDRESS_SCHEMA,
                "areas": array_of(
                    object_of(
                        {
                            **found,
                            "failures": failures,
                            "givenUp": {"type": ["integer", "string", "null"]},
                            "largest": {**COUNT, "description": "The most that one read returned"},
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


def _stream(**events: str) -> dict[str, Any]:
    """An answer of events; each has JSON of a schema for its data."""
    kinds = [
        object_of(
            {
                "event": {"const": name},
                "data": {
                    "type": "string",
                    "contentMediaType": "application/json",
                    "contentSchema": ref(schema),
                },
            }
        )
        for name, schema in events.items()
    ]
    content = {"text/event-stream": {"schema": {"oneOf": kinds}}}
    return {"description": "Server-sent events, each of which is one of these", "content": content}


def _refusals(*reasons: str) -> dict[str, Any]:
    """The answers of an operation that these reasons refuse."""
    return refused_by(REFUSALS.of((*reasons, *EVERYWHERE)))


def _refused(row: Refusal) -> dict[str, Any]:
    """The answer to what is refused, or has failed."""
    said = json_answer(row.means, ref("Error"), {"success": False, "error": row.example})
    reason = {"schema": {"enum": list(row.reasons)}, "description": "Why, in a word"}
    return {**said, "headers": {"Holdfast-Reason": reason}}
