"""The OpenAPI document, made from what the endpoints say of themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.gateway import surveying, watching
from holdfast.gateway.endpoint import EXAMPLE, array_of
from holdfast.gateway.fields import Field, Schema, integer, timeout
from holdfast.gateway.reading import TYPED
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.gateway.endpoint import Operation
    from holdfast.gateway.settings import GatewayLimits, Settings

STATUS = "/api/gateway"

TEXTS = {
    "400": ("Not what is asked for", "port is 0, allowed is an integer 1 to 65535"),
    "401": ("No token, or one that is not known", "the token is not known"),
    "403": (
        "The target is not in the egress list, writes are off, or a page of another site asks",
        "192.168.7.7, port 502, is not in the egress list of this gateway",
    ),
    "405": ("Not with this method", "Method not allowed: allowed are POST, OPTIONS"),
    "408": (
        "The body did not arrive in time; the connection is closed",
        "1024 bytes came in time, more were announced",
    ),
    "413": (
        "The body is too large; the connection is closed",
        "the body has more than 65536 bytes",
    ),
    "415": (
        "Neither `application/json` nor what curl says instead, or compressed",
        'Content-Type is "text/plain", allowed is application/json',
    ),
    "500": ("No connection, TLS not agreed on, or no reply in time", "Connection timeout"),
    "503": (
        "Too much at once, or the gateway stops",
        "128 requests are under way, which is the limit",
    ),
}
"""What a status means, and an example of an error."""

POSTED = ("400", "403", "405", "408", "413", "415", "500", "503")
STREAMED = ("400", "403", "405", "500", "503")


def document(version: str, endpoints: Iterable[Operation], settings: Settings) -> dict[str, Any]:
    """The document of a gateway with these settings."""
    secured = bool(settings.tokens)
    limits = settings.limits
    paths: dict[str, Any] = {each.path: {"post": _endpoint(each, limits)} for each in endpoints}
    paths |= _streams(limits) | {STATUS: {"get": _status()}}
    for path in paths.values():
        for operation in path.values():
            operation["security"] = [{"token": []}] if secured else []
            denied = {"401": _ref("Refused401", "responses")} if secured else {}
            operation["responses"] |= denied
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
            "responses": {f"Refused{status}": _refused(status) for status in TEXTS},
            **(schemes if secured else {}),
        },
    }


def _endpoint(endpoint: Operation, limits: GatewayLimits) -> dict[str, Any]:
    longest = round(1000 * limits.timeout)
    fields = (*endpoint.fields, timeout(min(endpoint.timeout, longest), longest))
    answer = {"success": {"const": True}, **_target(), **endpoint.properties}
    if endpoint.broadcast:
        answer["note"] = {"type": "string", "description": "Of a broadcast: nobody confirms it"}
    whole = _object(answer, optional=(*endpoint.optional, "note"))
    example = {"success": True, **endpoint.answer}
    return {
        "operationId": endpoint.name,
        "summary": endpoint.summary,
        "description": endpoint.description,
        "requestBody": _body(fields, endpoint.examples),
        "responses": {
            "200": _answer(
                "What the device answered", {"oneOf": [whole, _ref("ModbusException")]}, example
            ),
            **_refusals(*POSTED),
        },
    }


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
                    **_refusals(*POSTED),
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
                    **_refusals(*STREAMED),
                },
            }
        },
    }


def _status() -> dict[str, Any]:
    return {
        "operationId": "status",
        "summary": "What this gateway may do",
        "responses": {
            "200": _answer(
                "Its version, and its limits",
                _ref("Status"),
                {
                    "version": "0.1.0",
                    "writes": False,
                    "tokens": False,
                    "allow": ["10.0.0.0/8:502"],
                    "limits": {"timeout": 60000, "interval": 100},
                    "connections": 2,
                },
            ),
            **_refusals("403", "405"),
        },
    }


def _documents() -> dict[str, Any]:
    """The document itself, as JSON and as a page, and the console."""
    html = {
        "description": "HTML",
        "content": {"text/html": {"schema": {"type": "string"}}},
    }
    whole = _answer("OpenAPI 3.1", {"type": "object"})
    return {
        path: {
            "get": {
                "operationId": name,
                "summary": summary,
                "security": [],
                "responses": {"200": answer, **_refusals("405")},
            }
        }
        for path, name, summary, answer in (
            ("/openapi.json", "openapi", "This document", whole),
            ("/docs", "docs", "This document as a page", html),
            ("/", "console", "The console, for a browser", html),
        )
    }


COUNT: Schema = {"type": "integer", "minimum": 0}
ADDRESS = integer(0, 65535)
VALUE: Schema = {"type": ["integer", "boolean"]}
AREA: Schema = {"enum": list(AREAS)}
RANGES: Schema = {
    **array_of({**array_of(ADDRESS), "minItems": 2, "maxItems": 2}),
    "description": "First and last addresses",
}
NOW: dict[str, Schema] = {
    "time": {**COUNT, "description": "Milliseconds since 1970"},
    "rtt": COUNT,
}


def _schemas() -> dict[str, Schema]:
    """Schemas that are named: errors, the status, and the data of events."""
    said: dict[str, Schema] = {"success": {"const": False}, "error": {"type": "string"}}
    about = {"functionCode": integer(1, 4), "address": ADDRESS, "quantity": integer(1, 2000)}
    return {
        "Error": _object(said),
        "ModbusException": _object(
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
        "Status": _object(
            {
                "version": {"type": "string"},
                "writes": {"type": "boolean"},
                "tokens": {"type": "boolean"},
                "allow": array_of({"type": "string"}),
                "limits": _object({"timeout": COUNT, "interval": COUNT}),
                "connections": {**COUNT, "description": "Devices that it has a connection to"},
            }
        ),
        **_schemas_of_watches(),
        **_schemas_of_maps(),
    }


def _schemas_of_watches() -> dict[str, Schema]:
    typed: dict[str, Schema] = {"index": COUNT, "value": {}, "text": {"type": "string"}}
    return {
        "Values": _object(
            {
                **NOW,
                "address": ADDRESS,
                "quantity": integer(1, 2000),
                "format": {"enum": ["coils", "registers"]},
                "values": array_of(VALUE),
                **TYPED,
            },
            optional=tuple(TYPED),
        ),
        "Change": _object(
            {
                **NOW,
                "changes": array_of(_object({"address": ADDRESS, "value": VALUE})),
                "typed": array_of(_object(typed)),
            },
            optional=("typed",),
        ),
        "Problem": _object({**NOW, "error": {"type": "string"}, "reason": {"type": "string"}}),
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
        "Progress": _object(
            {
                "at": {**COUNT, "description": "Addresses that were dealt with"},
                "total": COUNT,
                "requests": COUNT,
                "areas": array_of(_object(found, optional=("ranges",))),
            }
        ),
        "Map": _object(
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
                "first": ADDRESS,
                "last": ADDRESS,
                "areas": array_of(
                    _object(
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
    return {"host": {"type": "string"}, "port": integer(1, 65535), "unitId": integer(0, 255)}


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


def _object(properties: dict[str, Schema], *, optional: Sequence[str] = ()) -> Schema:
    """An object that has all of these but for the optional ones, and nothing else."""
    return {
        "type": "object",
        "required": [name for name in properties if name not in optional],
        "properties": properties,
        "additionalProperties": False,
    }


def _ref(name: str, kind: str = "schemas") -> Schema:
    return {"$ref": f"#/components/{kind}/{name}"}


def _answer(description: str, schema: Schema, example: object = None) -> dict[str, Any]:
    content = {"schema": schema} | ({} if example is None else {"example": example})
    return {"description": description, "content": {"application/json": content}}


def _stream(**events: str) -> dict[str, Any]:
    """An answer of events; each has JSON of a schema for its data."""
    kinds = [
        _object(
            {
                "event": {"const": name},
                "data": {
                    "type": "string",
                    "contentMediaType": "application/json",
                    "contentSchema": _ref(schema),
                },
            }
        )
        for name, schema in events.items()
    ]
    content = {"text/event-stream": {"schema": {"oneOf": kinds}}}
    return {"description": "Server-sent events, each of which is one of these", "content": content}


def _refusals(*statuses: str) -> dict[str, Any]:
    return {status: _ref(f"Refused{status}", "responses") for status in statuses}


def _refused(status: str) -> dict[str, Any]:
    title, error = TEXTS[status]
    answer = _answer(title, _ref("Error"), {"success": False, "error": error})
    answer["headers"] = {
        "Holdfast-Reason": {"schema": {"type": "string"}, "description": "Why, in a word"}
    }
    if status == "401":
        answer["headers"]["WWW-Authenticate"] = {"schema": {"const": "Bearer"}}
    if status == "405":
        answer["headers"]["Allow"] = {"schema": {"type": "string"}}
    if status == "503":
        answer["headers"]["Retry-After"] = {"schema": {"type": "string"}}
    return answer
