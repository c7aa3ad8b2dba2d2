"""The JSON Schema of a configuration, for editors and for error messages."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from pydantic.json_schema import GenerateJsonSchema

from holdfast.config.models.root import Config

if TYPE_CHECKING:
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core.core_schema import ModelSchema

DIALECT = GenerateJsonSchema.schema_dialect


class _Described(GenerateJsonSchema):
    """Describes each key by the docstring below it.

    `use_attribute_docstrings` of pydantic does the same, but reads the source of all models
    whenever they are imported, which takes as long as half of all other imports.
    """

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """The schema of one model."""
        made = super().model_schema(schema)
        for kind in schema["cls"].__mro__:
            for key, text in _docstrings(kind.__module__).get(kind.__name__, {}).items():
                if key in made["properties"]:
                    made["properties"][key].setdefault("description", text)
        return made


@functools.cache
def _docstrings(module: str) -> dict[str, dict[str, str]]:
    """The docstrings of keys, for each class of a module."""
    if not module.startswith(__package__):
        return {}
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {
        kind.name: {
            key.target.id: inspect.cleandoc(text.value.value)
            for key, text in pairwise(kind.body)
            if isinstance(key, ast.AnnAssign)
            and isinstance(key.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
            and isinstance(text.value.value, str)
        }
        for kind in tree.body
        if isinstance(kind, ast.ClassDef)
    }


def json_schema() -> dict[str, Any]:
    """The JSON Schema, draft 2020-12, with descriptions. It accepts both forms of an area."""
    return _json_schema(_Described)


@functools.cache
def cached() -> dict[str, Any]:
    """The JSON Schema without descriptions, built once. Callers must not change it."""
    return _json_schema(GenerateJsonSchema)


def _json_schema(generator: type[GenerateJsonSchema]) -> dict[str, Any]:
    schema = Config.model_json_schema(mode="validation", schema_generator=generator)
    return {"$schema": DIALECT, **_tidy(schema), "title": "Holdfast configuration"}


def _tidy(node: dict[str, Any]) -> dict[str, Any]:
    """Adds a title to every property, and drops `null` defaults: they mean an omitted key."""
    tidy = {key: _tidy(value) if isinstance(value, dict) else value for key, value in node.items()}
    if tidy.get("default", ...) is None:
        del tidy["default"]
    for key, value in tidy.get("properties", {}).items():
        value["title"] = key.replace("_", " ").capitalize()
    return tidy
