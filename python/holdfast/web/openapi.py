"""What OpenAPI documents are made of: objects, answers, refusals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.web.refusals import HEADERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from holdfast.web.refusals import Refusal

Schema: TypeAlias = dict[str, Any]

DOCUMENT = "/openapi.json"
PAGE = "/docs"
"""Where every application has its document, and that as a page."""


def integer(least: int, most: int) -> Schema:
    """An integer of a range."""
    return {"type": "integer", "minimum": least, "maximum": most}


def array_of(items: Schema) -> Schema:
    """A list."""
    return {"type": "array", "items": items}


def object_of(properties: dict[str, Schema], *, optional: Sequence[str] = ()) -> Schema:
    """An object that has all of these but for the optional ones, and nothing else."""
    return {
        "type": "object",
        "required": [name for name in properties if name not in optional],
        "properties": properties,
        "additionalProperties": False,
    }


def ref(name: str, kind: str = "schemas") -> Schema:
    """What a component is referred to by."""
    return {"$ref": f"#/components/{kind}/{name}"}


def json_answer(description: str, schema: Schema, example: object = None) -> dict[str, Any]:
    """An answer in JSON."""
    content = {"schema": schema} | ({} if example is None else {"example": example})
    return {"description": description, "content": {"application/json": content}}


def html_answer() -> dict[str, Any]:
    """An answer in HTML."""
    return {"description": "HTML", "content": {"text/html": {"schema": {"type": "string"}}}}


def parameter(name: str, schema: Schema, example: object, description: str) -> dict[str, Any]:
    """A parameter that is needed in a query."""
    return {
        "name": name,
        "in": "query",
        "required": True,
        "description": description,
        "schema": schema,
        "example": example,
    }


def refused_by(rows: Iterable[Refusal]) -> dict[str, Any]:
    """The answers of an operation that these refuse, each a component."""
    return {str(row.status): ref(_component(row), "responses") for row in rows}


def refusal_components(
    rows: Iterable[Refusal], said: Callable[[Refusal], dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """The components that `refused_by` refers to; `said` makes an answer of a row."""
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
