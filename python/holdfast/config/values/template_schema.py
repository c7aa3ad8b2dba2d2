"""The JSON Schema of devices that are written once for many, which have a key `for`."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from pydantic.config import JsonDict

_VARIABLE = "[A-Za-z_][A-Za-z0-9_]*"
_NAME = rf"^([A-Za-z0-9_.-]|\{{{_VARIABLE}(:0[1-9])?\}}){{1,64}}$"
_NUMBER: JsonDict = {"type": "integer", "minimum": 0}


def with_templates(schema: JsonDict) -> None:
    """Adds them to the JSON Schema of all devices.

    Text with a variable may be the value of any of their keys, so only `for` is checked.
    """
    numbers: JsonDict = {
        "anyOf": [
            _NUMBER,
            {"type": "array", "items": _NUMBER, "minItems": 1},
            {"type": "string", "pattern": "^[0-9]{1,9}-[0-9]{1,9}$"},
        ]
    }
    variables: JsonDict = {
        "type": "object",
        "description": "The numbers of each variable: {n: 1-300} or {n: [1, 2, 5]}.",
        "propertyNames": {"pattern": f"^{_VARIABLE}$"},
        "additionalProperties": numbers,
        "minProperties": 1,
    }
    (device,) = cast("JsonDict", schema.pop("patternProperties")).values()
    schema["propertyNames"] = {"pattern": _NAME}
    schema["additionalProperties"] = {
        "if": {"required": ["for"]},
        "then": {"type": "object", "properties": {"for": variables}, "required": ["url"]},
        "else": device,
    }
