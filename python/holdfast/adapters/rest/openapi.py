"""The OpenAPI document: every route, what it takes, and what it answers."""

from __future__ import annotations

from typing import Any, TypeAlias

from holdfast.types import AREAS

Schema: TypeAlias = dict[str, Any]

REGISTER_AREAS = AREAS[2:]
BIT_AREAS = AREAS[:2]

REASONS = {
    "400": ("invalid_value", "malformed", "invalid_area", "out_of_range"),
    "401": ("unauthorized",),
    "403": ("not_granted",),
    "404": ("unknown_memory", "not_found", "not_configured"),
    "405": ("method_not_allowed",),
    "408": ("timeout",),
    "413": ("too_large",),
    "415": ("not_json",),
}
"""The reasons of refusals, by status."""

TEXTS = {
    "400": (
        "Not what is asked for: the text, a parameter, an area, an address or a value",
        "values[2] is 70000, outside 0..65535",
    ),
    "401": ("No token, or one that is not known", "the token is not known"),
    "403": (
        "The token does not reach this memory or area, or may not write",
        "area coils is not granted to edge-gateway",
    ),
    "404": ("There is no such thing", 'no memory "plant_z"'),
    "405": ("Not with this method", "allowed are POST, OPTIONS"),
    "408": (
        "The body did not arrive in time; the connection is closed",
        "1024 bytes came in time, more were announced",
    ),
    "413": (
        "The body is too large; the connection is closed",
        "the body has more than 8388608 bytes",
    ),
    "415": (
        "Not `application/json`, or compressed",
        'Content-Type is "text/plain", allowed is application/json',
    ),
}
"""What a status means, and an example of a detail."""


def document(version: str, max_body: int, *, secured: bool) -> dict[str, Any]:
    """The document of a server with this limit, `secured` by tokens or not."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "Holdfast REST",
            "version": version,
            "summary": "Writes and reads Modbus memories.",
            "description": "A write is checked as a whole and then done as one step, or not at "
            "all: no reader ever sees a part of it, also where a batch touches several memories. "
            "Nothing is converted, cut or wrapped. An integer is written as one: `1.0` and "
            "`1e2` are refused. "
            f"A body has at most {max_body} bytes.",
        },
        "servers": [{"url": "/"}],
        "paths": _paths(secured),
        "components": {
            "schemas": _schemas(),
            "responses": {f"Refused{status}": _refused(status) for status in REASONS},
            **(
                {
                    "securitySchemes": {
                        "token": {
                            "type": "http",
                            "scheme": "bearer",
                            "description": "A token that the configuration names by its SHA-256.",
                        }
                    }
                }
                if secured
                else {}
            ),
        },
    }


def _paths(secured: bool) -> dict[str, Any]:
    security: list[dict[str, list[str]]] = [{"token": []}] if secured else []
    denied = ("401",) if secured else ("403",)
    return {
        "/api/v1/ingest": {
            "post": {
                "operationId": "ingest",
                "summary": "Write one command, or several as one step",
                "description": "In a refusal, `command` is the place of the command in the batch "
                "and `index` the place of the value in the command, both from 0. Where ranges of "
                "a batch overlap, the later command wins.",
                "security": security,
                "requestBody": {
                    "required": True,
                    "content": {
                        "application/json": {
                            "schema": {"oneOf": [_ref("Command"), _ref("Batch")]},
                            "examples": {
                                "registers": {
                                    "summary": "Three registers",
                                    "value": _command("holding_registers", 0, [100, 200, 300]),
                                },
                                "bits": {
                                    "summary": "Two bits",
                                    "value": _command("coils", 8, [True, 0]),
                                },
                                "batch": {
                                    "summary": "Two commands as one step",
                                    "value": [
                                        _command("input_registers", 0, [7]),
                                        _command("discrete_inputs", 3, [1]),
                                    ],
                                },
                            },
                        }
                    },
                },
                "responses": {
                    "200": _answer(
                        "Written",
                        {"oneOf": [_ref("Accepted"), _ref("BatchAccepted")]},
                        {"status": "accepted", "memory": "plant_a", "written": 3},
                    ),
                    **_refusals("400", *(("401",) if secured else ()), "403", "404", "405"),
                    **_refusals("408", "413", "415"),
                },
            }
        },
        "/api/v1/memory/read": {
            "get": {
                "operationId": "read",
                "summary": "Read a range, all of one moment",
                "security": security,
                "parameters": [
                    _parameter("memory", {"type": "string"}, "plant_a", "The memory"),
                    _parameter("area", _ref("Area"), "holding_registers", "The area"),
                    _parameter(
                        "address",
                        {"type": "integer", "minimum": 0, "maximum": 65535},
                        0,
                        "The first address",
                    ),
                    _parameter(
                        "count",
                        {"type": "integer", "minimum": 1, "maximum": 65536},
                        3,
                        "How many bits or registers",
                    ),
                ],
                "responses": {
                    "200": _answer(
                        "The values, bits as 0 and 1",
                        _ref("Values"),
                        {"values": [100, 200, 300]},
                    ),
                    **_refusals("400", *(("401",) if secured else ()), "403", "404", "405"),
                },
            }
        },
        "/api/v1/health": {
            "get": {
                "operationId": "health",
                "summary": "Whether the server answers",
                "security": [],
                "responses": {
                    "200": _answer("It does", _ref("Health"), {"status": "ok"}),
                    **_refusals("405"),
                },
            }
        },
        "/api/v1/diagnostics/memory": {
            "get": {
                "operationId": "memories",
                "summary": "The memories that the token reaches",
                "security": security,
                "responses": {
                    "200": _answer(
                        "Their areas, and their seals",
                        _ref("Memories"),
                        {
                            "memories": {
                                "plant_a": {
                                    "areas": {
                                        "coils": {"start": 0, "size": 1024},
                                        "holding_registers": {"start": 0, "size": 4096},
                                    },
                                    "sealed": False,
                                    "opened": 1,
                                    "closed": 0,
                                }
                            }
                        },
                    ),
                    **_refusals(*denied, "405"),
                },
            }
        },
        "/api/v1/diagnostics/stats": {
            "get": {
                "operationId": "stats",
                "summary": "Every counter since the start",
                "security": security,
                "responses": {
                    "200": _answer(
                        "Listeners, devices, adapters, log and audit",
                        _ref("Stats"),
                        {
                            "uptime": 3600.25,
                            "listeners": {
                                "scada": {
                                    "requests": {"3": 7200},
                                    "exceptions": {"2": 1},
                                    "unanswered": 0,
                                    "connections": {"accepted": 2, "open": 1},
                                }
                            },
                            "devices": {
                                "meter": {
                                    "health": "ok",
                                    "age": 0.4,
                                    "requests": 7200,
                                    "valid": 7199,
                                    "timeouts": 1,
                                }
                            },
                            "adapters": {
                                "rest": {
                                    "state": "running",
                                    "restarts": 0,
                                    "last_error": None,
                                    "accepted": 120,
                                    "values": 360,
                                    "reads": 4,
                                    "refused": {"invalid_value": 1},
                                }
                            },
                            "events_lost": 0,
                            "audit": None,
                        },
                    ),
                    **_refusals(*denied, "405"),
                },
            }
        },
        "/api/v1/diagnostics/mqtt": {
            "get": {
                "operationId": "mqtt",
                "summary": "The connection to the MQTT broker",
                "security": security,
                "responses": {
                    "200": _answer(
                        "How it is",
                        _ref("Mqtt"),
                        {
                            "connected": True,
                            "broker": "mqtts://broker.example:8883",
                            "topics": ["plant/ingest"],
                            "last_error": None,
                        },
                    ),
                    **_refusals(*denied, "404", "405"),
                },
            }
        },
        "/openapi.json": {
            "get": {
                "operationId": "openapi",
                "summary": "This document",
                "security": [],
                "responses": {
                    "200": _answer("OpenAPI 3.1", {"type": "object"}),
                    **_refusals("405"),
                },
            }
        },
        "/docs": {
            "get": {
                "operationId": "docs",
                "summary": "This document as a page",
                "security": [],
                "responses": {
                    "200": {
                        "description": "HTML",
                        "content": {"text/html": {"schema": {"type": "string"}}},
                    },
                    **_refusals("405"),
                },
            }
        },
    }


def _schemas() -> dict[str, Schema]:
    counter = {"type": "integer", "minimum": 0}
    text_or_null = {"type": ["string", "null"]}
    return {
        "Area": {"type": "string", "enum": list(AREAS)},
        "Command": {"oneOf": [_ref("RegisterCommand"), _ref("BitCommand"), _ref("BoolsCommand")]},
        "Batch": {"type": "array", "minItems": 1, "items": _ref("Command")},
        "RegisterCommand": _command_schema(
            REGISTER_AREAS, "values", {"type": "integer", "minimum": 0, "maximum": 65535}
        ),
        "BitCommand": _command_schema(BIT_AREAS, "values", _ref("Bit")),
        "BoolsCommand": _command_schema(BIT_AREAS, "bools", _ref("Bit")),
        "Bit": {"enum": [0, 1, False, True]},
        "Accepted": _object(
            {
                "status": {"const": "accepted"},
                "memory": {"type": "string"},
                "written": {"type": "integer", "minimum": 1},
            }
        ),
        "BatchAccepted": _object(
            {
                "status": {"const": "accepted"},
                "commands": {"type": "integer", "minimum": 1},
                "written": {"type": "integer", "minimum": 1},
            }
        ),
        "Values": _object(
            {
                "values": {
                    "type": "array",
                    "minItems": 1,
                    "items": {"type": "integer", "minimum": 0, "maximum": 65535},
                }
            }
        ),
        "Health": _object({"status": {"const": "ok"}}),
        "Memories": _object(
            {"memories": {"type": "object", "additionalProperties": _ref("Memory")}}
        ),
        "Memory": _object(
            {
                "areas": {
                    "type": "object",
                    "propertyNames": _ref("Area"),
                    "additionalProperties": _object(
                        {"start": counter, "size": {"type": "integer", "minimum": 1}}
                    ),
                },
                "sealed": {
                    "type": "boolean",
                    "description": "Whether Modbus clients are refused for now",
                },
                "opened": counter | {"description": "How often the seal opened"},
                "closed": counter | {"description": "How often it closed again"},
            }
        ),
        "Stats": _object(
            {
                "uptime": {"type": "number", "description": "Seconds"},
                "listeners": {
                    "type": "object",
                    "description": "By the name of the listener: requests by function code, "
                    "exceptions by code, connections, frames",
                    "additionalProperties": {"type": "object"},
                },
                "devices": {
                    "type": "object",
                    "description": "By the name of the device: health, seconds since the last "
                    "valid answer, requests by their outcomes, polls, reads, packets forwarded",
                    "additionalProperties": {
                        "type": "object",
                        "required": ["health"],
                        "properties": {
                            "health": {"enum": ["unknown", "ok", "error", "stale", "disabled"]},
                        },
                    },
                },
                "adapters": {
                    "type": "object",
                    "description": "By the name of the adapter: messages accepted, values written, "
                    "reads, refusals by reason, and what it says of itself",
                    "additionalProperties": {
                        "type": "object",
                        "required": ["state", "restarts", "last_error"],
                        "properties": {
                            "state": {"enum": ["running", "failed", "stopped"]},
                            "restarts": counter,
                            "last_error": text_or_null,
                        },
                    },
                },
                "events_lost": counter,
                "audit": {
                    "type": ["object", "null"],
                    "description": "Lines written, and lines that failed",
                },
            }
        ),
        "Mqtt": {
            "type": "object",
            "required": ["connected", "broker", "topics", "last_error"],
            "properties": {
                "connected": {"type": "boolean"},
                "broker": text_or_null,
                "topics": {"type": "array"},
                "last_error": text_or_null,
            },
        },
        "Refusal": {
            "type": "object",
            "required": ["status", "reason", "detail"],
            "properties": {
                "status": {"const": "rejected"},
                "reason": {"enum": [word for words in REASONS.values() for word in words]},
                "command": counter | {"description": "The place of the command in the batch"},
                "index": counter | {"description": "The place of the value in the command"},
                "detail": {"type": "string", "description": "A sentence for people"},
            },
            "additionalProperties": False,
        },
    }


def _object(properties: dict[str, Schema]) -> Schema:
    """An object that has all of these, and nothing else."""
    return {
        "type": "object",
        "required": list(properties),
        "properties": properties,
        "additionalProperties": False,
    }


def _command_schema(areas: tuple[str, ...], key: str, item: Schema) -> Schema:
    return _object(
        {
            "memory": {"type": "string"},
            "area": {"enum": list(areas)},
            "address": {"type": "integer", "minimum": 0, "maximum": 65535},
            key: {"type": "array", "minItems": 1, "items": item},
        }
    )


def _command(area: str, address: int, values: list[int]) -> dict[str, object]:
    return {"memory": "plant_a", "area": area, "address": address, "values": values}


def _ref(name: str, kind: str = "schemas") -> Schema:
    return {"$ref": f"#/components/{kind}/{name}"}


def _parameter(name: str, schema: Schema, example: object, description: str) -> dict[str, Any]:
    return {
        "name": name,
        "in": "query",
        "required": True,
        "description": description,
        "schema": schema,
        "example": example,
    }


def _answer(description: str, schema: Schema, example: object = None) -> dict[str, Any]:
    content = {"schema": schema} | ({} if example is None else {"example": example})
    return {"description": description, "content": {"application/json": content}}


def _refusals(*statuses: str) -> dict[str, Any]:
    return {status: _ref(f"Refused{status}", "responses") for status in statuses}


def _refused(status: str) -> dict[str, Any]:
    title, detail = TEXTS[status]
    where = {"index": 2} if status == "400" else {}
    reason = REASONS[status][0]
    example = {"status": "rejected", "reason": reason, **where, "detail": detail}
    answer = _answer(title, _ref("Refusal"), example)
    if status == "401":
        answer["headers"] = {"WWW-Authenticate": {"schema": {"const": "Bearer"}}}
    if status == "405":
        answer["headers"] = {"Allow": {"schema": {"type": "string"}}}
    return answer
