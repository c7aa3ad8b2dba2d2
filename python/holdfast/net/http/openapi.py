"""Makes the OpenAPI document of an application from its table of operations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.net.http.refusals import HEADERS
from holdfast.net.http.schemas import TEXT, Schema, object_of, ref

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from holdfast.net.http.fields import Field
    from holdfast.net.http.operations import Body, Operation
    from holdfast.net.http.refusals import Refusal, Refusals

OF_BODY = ("malformed", "timeout", "too_large", "not_json")
"""The reasons of refusals that every operation with a body has."""


@dataclass(frozen=True)
class Api:
    """What a document has besides its operations."""

    title: str
    summary: str
    description: str
    schemas: dict[str, Schema]
    refusals: Refusals
    refused: Callable[[Refusal], dict[str, Any]]
    """Returns the response of a refusal."""


def document(
    api: Api, version: str, operations: Iterable[Operation[Any]], *, secured: bool
) -> dict[str, Any]:
    """Returns the document. `secured`: tokens are required."""
    documented = [each for each in operations if each.answer is not None]
    rows = {row.status: row for each in documented for row in _rows(api, each, secured=secured)}
    token = {
        "type": "http",
        "scheme": "bearer",
        "description": "A token whose SHA-256 is in the configuration.",
    }
    return {
        "openapi": "3.1.0",
        "info": {
            "title": api.title,
            "version": version,
            "summary": api.summary,
            "description": api.description,
        },
        "servers": [{"url": "/"}],
        "paths": {
            each.path: {each.method.lower(): _operation(api, each, secured=secured)}
            for each in documented
        },
        "components": {
            "schemas": api.schemas,
            "responses": {
                _component(row): _with_headers(row, api.refused(row)) for row in rows.values()
            },
            **({"securitySchemes": {"token": token}} if secured else {}),
        },
    }


def _rows(api: Api, operation: Operation[Any], *, secured: bool) -> list[Refusal]:
    """Returns the refusals and failures of an operation, sorted by status code."""
    reasons = [*operation.refusals, "method_not_allowed"]
    if not operation.is_public:
        reasons += ["foreign_page", "unauthorized"] if secured else ["foreign_page"]
    if operation.body is not None:
        reasons += OF_BODY
    elif operation.parameters:
        reasons.append("malformed")
    rows = [*api.refusals.of(reasons), *operation.failures]
    return sorted(rows, key=lambda row: row.status)


def _operation(api: Api, operation: Operation[Any], *, secured: bool) -> dict[str, Any]:
    made: dict[str, Any] = {"operationId": operation.name, "summary": operation.summary}
    if operation.description:
        made["description"] = operation.description
    made["security"] = [{"token": []}] if secured and not operation.is_public else []
    if operation.body is not None:
        made["requestBody"] = _body(operation.body)
    parameters = [
        *(_parameter(each, "query") for each in operation.parameters),
        *(_parameter(each, "header") for each in operation.headers),
    ]
    if parameters:
        made["parameters"] = parameters
    rows = _rows(api, operation, secured=secured)
    refused = {str(row.status): ref(_component(row), "responses") for row in rows}
    return made | {"responses": {"200": operation.answer, **refused}}


def _body(body: Body) -> dict[str, Any]:
    examples = {
        f"example{number}": {"summary": title, "value": value}
        for number, (title, value) in enumerate(body.examples.items(), start=1)
    }
    content = {"application/json": {"schema": body.schema, "examples": examples}}
    return {"required": True, "content": content}


def _parameter(field: Field, place: str) -> dict[str, Any]:
    return {
        "name": field.name,
        "in": place,
        "required": field.required,
        "description": field.text,
        "schema": field.typed,
        "example": field.default if field.example is None else field.example,
    }


def _component(row: Refusal) -> str:
    return f"Refused{row.status}"


def _with_headers(row: Refusal, response: dict[str, Any]) -> dict[str, Any]:
    headers: dict[str, Any] = dict(response.get("headers", {}))
    if row.status in HEADERS:
        name, value = HEADERS[row.status]
        headers[name] = {"schema": {"const": value}}
    if row.status == 405:
        headers["Allow"] = {"schema": TEXT}
    return {**response, "headers": headers} if headers else response


def json_answer(description: str, schema: Schema, example: object = None) -> dict[str, Any]:
    """A JSON response."""
    content = {"schema": schema} | ({} if example is None else {"example": example})
    return {"description": description, "content": {"application/json": content}}


def html_answer() -> dict[str, Any]:
    """An HTML response."""
    return {"description": "HTML", "content": {"text/html": {"schema": TEXT}}}


def stream_answer(**events: str) -> dict[str, Any]:
    """A response of server-sent events; the value of each event is the schema of its data."""
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
    return {"description": "A stream of these server-sent events", "content": content}
