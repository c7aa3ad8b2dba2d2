"""The JSON Schema of a configuration, for editors and for error messages."""

from __future__ import annotations

import functools
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from holdfast.config.model import Config

DIALECT = GenerateJsonSchema.schema_dialect


def json_schema() -> dict[str, Any]:
    """The JSON Schema, draft 2020-12. It accepts both forms of an area."""
    schema = Config.model_json_schema(mode="validation")
    return {"$schema": DIALECT, **_tidy(schema), "title": "Holdfast configuration"}


@functools.cache
def cached() -> dict[str, Any]:
    """The JSON Schema, built once. Callers must not change it."""
    return json_schema()


def _tidy(node: dict[str, Any]) -> dict[str, Any]:
    """Adds a title to every property, and drops `null` defaults: they mean an omitted key."""
    tidy = {key: _tidy(value) if isinstance(value, dict) else value for key, value in node.items()}
    if tidy.get("default", ...) is None:
        del tidy["default"]
    for key, value in tidy.get("properties", {}).items():
        value["title"] = key.replace("_", " ").capitalize()
    return tidy
