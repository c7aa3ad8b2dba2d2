"""The OpenAPI document, generated from the routes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.adapters.rest.refusals import EVERYWHERE, REFUSALS
from holdfast.adapters.rest.routes import ROUTES
from holdfast.adapters.rest.schemas import ANSWERS, COMMANDS, DIAGNOSTICS
from holdfast.web.openapi import json_answer, parameter, ref, refusal_components, refused_by

if TYPE_CHECKING:
    from holdfast.adapters.rest.routes import Body, Route
    from holdfast.web.refusals import Refusal

TOKEN = {
    "type": "http",
    "scheme": "bearer",
    "description": "A token whose SHA-256 is in the configuration.",
}


def document(version: str, max_body: int, *, secured: bool) -> dict[str, Any]:
    """Returns the document of a server with this limit in bytes. `secured`: tokens are required."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "Holdfast REST",
            "version": version,
            "summary": "Reads and writes Modbus memories.",
            "description": "A write is atomic, even a batch that writes to several memories: "
            "either all of it is carried out or nothing, and no reader sees only a part of it. "
            "Values are never converted, truncated or wrapped. An integer has no fraction and no "
            "exponent: `1.0` and `1e2` are refused. "
            f"A body has at most {max_body} bytes.",
        },
        "servers": [{"url": "/"}],
        "paths": {
            route.path: {route.method.lower(): _operation(route, secured=secured)}
            for route in ROUTES
        },
        "components": {
            "schemas": COMMANDS | ANSWERS | DIAGNOSTICS,
            "responses": refusal_components(REFUSALS.rows, _refused),
            **({"securitySchemes": {"token": TOKEN}} if secured else {}),
        },
    }


def _operation(route: Route, *, secured: bool) -> dict[str, Any]:
    needs_token = secured and not route.is_open
    described = {} if route.description is None else {"description": route.description}
    asked: dict[str, Any] = {}
    if route.body is not None:
        asked["requestBody"] = _body(route.body)
    if route.parameters:
        asked["parameters"] = [
            parameter(each.name, each.described(), each.example, each.text, default=each.default)
            for each in route.parameters
        ]
    return {
        "operationId": route.name,
        "summary": route.summary,
        **described,
        "security": [{"token": []}] if needs_token else [],
        **asked,
        "responses": {
            "200": route.answer,
            **refused_by(REFUSALS.of(_reasons(route, secured=secured))),
        },
    }


def _reasons(route: Route, *, secured: bool) -> tuple[str, ...]:
    """Returns the reasons for which a route can refuse a request."""
    asking = "unauthorized" if secured else "not_granted"
    return (*route.refusals, *EVERYWHERE, *(() if route.is_open else (asking,)))


def _body(body: Body) -> dict[str, Any]:
    examples = {
        name: {"summary": title, "value": value} for name, (title, value) in body.examples.items()
    }
    content = {"application/json": {"schema": body.schema, "examples": examples}}
    return {"required": True, "content": content}


def _refused(row: Refusal) -> dict[str, Any]:
    where = {"index": 2} if row.status == 400 else {}
    example = {"status": "rejected", "reason": row.reasons[0], **where, "detail": row.example}
    return json_answer(row.means, ref("Refusal"), example)
