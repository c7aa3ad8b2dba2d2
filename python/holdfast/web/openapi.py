"""Building blocks of OpenAPI documents: schemas, responses and refusals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.web.refusals import HEADERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from holdfast.web.refusals import Refusal

Schema: TypeAlias = dict[str, Any]

DOCUMENT = "/openapi.json"
PAGE = "/docs"
"""The paths of the OpenAPI document and of its page, in every application."""


def integer(least: int, most: int) -> Schema:
    """The schema of an integer from `least` to `most`."""
    return {"type": "integer", "minimum": least, "maximum": most}


def array_of(items: Schema) -> Schema:
    """The schema of an array."""
    return {"type": "array", "items": items}


def object_of(properties: dict[str, Schema], *, optional: Sequence[str] = ()) -> Schema:
    """The schema of an object with these properties and no others.

    Properties are required, except those in `optional`.
    """
    return {
        "type": "object",
        "required": [name for name in properties if name not in optional],
        "properties": properties,
        "additionalProperties": False,
    }


def ref(name: str, kind: str = "schemas") -> Schema:
    """A reference to a component."""
    return {"$ref": f"#/components/{kind}/{name}"}


def json_answer(description: str, schema: Schema, example: object = None) -> dict[str, Any]:
    """A JSON response."""
    content = {"schema": schema} | ({} if example is None else {"example": example})
    return {"description": description, "content": {"application/json": content}}


def html_answer() -> dict[str, Any]:
    """An HTML response."""
    return {"description": "HTML", "content": {"text/html": {"schema": {"type": "string"}}}}


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


def parameter(
    name: str, schema: Schema, example: object, description: str, *, default: object = None
) -> dict[str, Any]:
    """A query parameter, required unless it has a default."""
    more = {} if default is None else {"default": default}
    return {
        "name": name,
        "in": "query",
        "required": default is None,
        "description": description,
        "schema": schema | more,
        "example": example,
    }


def refused_by(rows: Iterable[Refusal]) -> dict[str, Any]:
    """The responses of an operation for these refusals, as references to components."""
    return {str(row.status): ref(_component(row), "responses") for row in rows}


def refusal_components(
    rows: Iterable[Refusal], said: Callable[[Refusal], dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """The components that `refused_by` refers to; `said` creates the response of a row."""
    return {_component(row): _with_headers(row, said(row)) for row in rows}


def _component(row: Refusal) -> str:
    return f"Refused{row.status}"


def _with_headers(row: Refusal, said: dict[str, Any]) -> dict[str, Any]:
    headers: dict[str, Any] = dict(said.get("headers", {}))
    if row.status in HEADERS:
        name, value = HEADERS[row.status]
        headers[name] = {"schema": {"const": value}}
    if row.status == 405:
        headers["Allow"] = {"schema": {"type": "string"}}
    return {**said, "headers": headers} if headers else said
