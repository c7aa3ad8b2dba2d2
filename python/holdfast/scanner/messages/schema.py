"""The JSON Schema of every message, generated from the message types."""

from __future__ import annotations

from typing import Any

import msgspec

from holdfast.scanner.messages import types

MESSAGES = tuple(
    each
    for each in vars(types).values()
    if isinstance(each, type) and issubclass(each, msgspec.Struct) and each.__struct_fields__
)


def json_schema() -> dict[str, Any]:
    """Returns a schema with a definition for each message, by name."""
    _, components = msgspec.json.schema_components(MESSAGES, ref_template="#/$defs/{name}")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Messages of the scanner",
        "$defs": dict(sorted(components.items())),
    }
