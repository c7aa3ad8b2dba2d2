"""JSON schemas, as OpenAPI documents and fields have them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Sequence

Schema: TypeAlias = dict[str, Any]

TEXT: Schema = {"type": "string"}
BOOLEAN: Schema = {"type": "boolean"}
NUMBER: Schema = {"type": "number"}
TEXT_OR_NULL: Schema = {"type": ["string", "null"]}
NUMBER_OR_NULL: Schema = {"type": ["number", "null"]}
COUNT: Schema = {"type": "integer", "minimum": 0}


def count(text: str) -> Schema:
    """The schema of a counter with a description."""
    return COUNT | {"description": text}


def integer(least: int, most: int) -> Schema:
    """The schema of an integer from `least` to `most`."""
    return {"type": "integer", "minimum": least, "maximum": most}


def array_of(items: Schema) -> Schema:
    """The schema of an array."""
    return {"type": "array", "items": items}


def array(items: Schema, most: int) -> Schema:
    """The schema of an array with 1 to `most` elements."""
    return {"type": "array", "minItems": 1, "maxItems": most, "items": items}


def object_of(
    properties: dict[str, Schema], *, optional: Sequence[str] = (), is_open: bool = False
) -> Schema:
    """The schema of an object with these properties; if it is open, it may have others too.

    Properties are required, except those in `optional`.
    """
    required = [name for name in properties if name not in optional]
    made = {"type": "object", "required": required, "properties": properties}
    return made if is_open else made | {"additionalProperties": False}


def map_of(values: Schema, text: str = "") -> Schema:
    """The schema of an object with any keys."""
    made: Schema = {"type": "object", "additionalProperties": values}
    return made | {"description": text} if text else made


def ref(name: str, kind: str = "schemas") -> Schema:
    """A reference to a component."""
    return {"$ref": f"#/components/{kind}/{name}"}
