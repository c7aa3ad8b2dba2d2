"""Builds a configuration from invalid data: everything that is valid, for the checks.

The validators of the models decide what is valid. Each key, each entry of a list and each value of
a mapping is valid or `INVALID` on its own, so that an error costs only the checks that need the
invalid value.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from pydantic_core import CoreConfig, SchemaValidator, ValidationError

from holdfast.config.models.base import INVALID, InvalidValue
from holdfast.config.models.root import Config

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from holdfast.config.models.base import Model


def partial(data: object, context: Mapping[str, Any]) -> Config:
    """The valid part of a configuration. A read of an invalid key raises `InvalidValue`."""
    config: Config = _validator().validate_python(data, context=dict(context))
    return config


@functools.cache
def _validator() -> SchemaValidator:
    schema = _tolerant(Config.__pydantic_core_schema__)
    return SchemaValidator(schema, CoreConfig(strict=True))


def _tolerant(node: Any) -> Any:
    """A schema that accepts anything, from the schema of a model or of a part of it."""
    if isinstance(node, list):
        return [_tolerant(each) for each in node]
    if not isinstance(node, dict):
        return node
    kind = node.get("type")
    made = {
        key: value if key in ("metadata", "serialization") else _tolerant(value)
        for key, value in node.items()
    }
    if kind == "model":
        return {
            "type": "function-after",
            "function": {"type": "no-info", "function": functools.partial(_built, node["cls"])},
            "schema": made["schema"],
            **({"ref": node["ref"]} if "ref" in node else {}),
        }
    if kind == "model-fields":
        made["extra_behavior"] = "ignore"
    elif kind == "tagged-union" and isinstance(node["discriminator"], str):
        made["discriminator"] = _tag_of(node["discriminator"], list(made["choices"]))
    elif kind == "model-field":
        made["schema"] = _or_invalid(made["schema"])
    elif kind == "function-after" and _is_model(node["schema"]):
        made["function"] = {**node["function"], "function": _if_valid(node["function"]["function"])}
    elif kind == "dict":
        made["keys_schema"] = _or_same(made["keys_schema"])
        made["values_schema"] = _or_invalid(made["values_schema"])
    elif kind == "tuple":
        made["items_schema"] = [_or_invalid(each) for each in made["items_schema"]]
    return made


def _tag_of(key: str, known: list[str]) -> Callable[[object], str | None]:
    """Selects a model by its key: the first one if that is invalid, to check all other keys."""

    def tag(value: object) -> str | None:
        if not isinstance(value, dict):
            return None
        return value[key] if value.get(key) in known else known[0]

    return tag


def _or_same(schema: dict[str, Any]) -> dict[str, Any]:
    """Makes an invalid key of a mapping valid, so that its value is checked all the same."""
    function = {"type": "no-info", "function": _same}
    return {"type": "function-wrap", "function": function, "schema": schema}


def _same(key: object, validate: Callable[[object], object]) -> object:
    try:
        return validate(key)
    except ValidationError:
        return key


def _is_model(node: dict[str, Any]) -> bool:
    while node["type"].startswith("function-"):
        node = node["schema"]
    return node["type"] in ("model", "definition-ref")


def _if_valid(validator: Callable[..., Any]) -> Callable[..., Any]:
    """A validator of a whole model, which does nothing if it needs an invalid key."""

    def validate(model: object, *more: object) -> Any:
        try:
            return validator(model, *more)
        except InvalidValue:
            return model

    return validate


def _or_invalid(schema: dict[str, Any]) -> dict[str, Any]:
    """Makes anything that a schema does not accept, and a missing value, `INVALID`."""
    if schema["type"] != "default":
        return {"type": "default", "schema": schema, "default": INVALID, "on_error": "default"}
    inner = {
        "type": "default",
        "schema": schema["schema"],
        "default": INVALID,
        "on_error": "default",
    }
    factory = schema.get("default_factory")
    takes_data = schema.get("default_factory_takes_data", False)
    if factory is not None and takes_data:
        schema = {**schema, "default_factory": functools.partial(_default, factory)}
    return {**schema, "schema": inner}


def _default(factory: Callable[[dict[str, Any]], object], data: dict[str, Any]) -> object:
    try:
        return factory(_Valid(data))
    except InvalidValue:
        return INVALID


class _Valid(dict[str, Any]):
    """The keys of a model, of which an invalid one can't be read."""

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if value is INVALID:
            raise InvalidValue
        return value


def _built(model: type[Model], parts: tuple[dict[str, Any], object, set[str]]) -> Model:
    """A model without its invalid keys."""
    values, _, given = parts
    built = model.model_construct(given, **values)
    for key, value in values.items():
        if value is INVALID:
            del built.__dict__[key]
    return built
