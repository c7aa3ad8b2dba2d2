"""The kinds of single values that a configuration holds, each with what is allowed.

Every kind is strict: text is not a number, a boolean is not an integer. A kind whose rule a JSON
Schema can't say in full raises `ValueError` with a message of its own.
"""

from __future__ import annotations

import re
import unicodedata
from typing import Annotated, Literal, TypeAlias, get_args

from pydantic import (
    AfterValidator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainSerializer,
    PlainValidator,
    Strict,
)
from pydantic.config import JsonDict
from pydantic.json_schema import JsonSchemaValue, WithJsonSchema
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from holdfast.config.addresses import Bind, Network, parse_bind, parse_source
from holdfast.config.words import choice, show

MOST_BYTES = 244
LONGEST_TIME = 31_622_400
SHORTEST_TIME = 0.001

NAME_FORM = "1 to 64 letters, digits, '_', '.' and '-'"
_NAME = r"[A-Za-z0-9_.-]{1,64}"
_BYTE = r"([01]?[0-9]?[0-9]|2[0-4][0-9]|25[0-5])"
_HIGH_BYTE = r"(12[89]|1[3-9][0-9]|2[0-4][0-9]|25[0-5])"

Area: TypeAlias = Literal["coils", "discrete_inputs", "holding_registers", "input_registers"]
BitArea: TypeAlias = Literal["coils", "discrete_inputs"]

AREAS: tuple[Area, ...] = get_args(Area)
BIT_AREAS: tuple[BitArea, ...] = get_args(BitArea)
FUNCTIONS = (1, 2, 3, 4, 5, 6, 8, 11, 15, 16, 17, 22, 23, 43)
WRITES = (5, 6, 15, 16, 22, 23)


def _name(value: object) -> str:
    if isinstance(value, str) and re.fullmatch(_NAME, value):
        return value
    quote = f"; write '{value}' to make it text" if type(value) is int else ""
    raise ValueError(f"found {show(value)}, allowed: {NAME_FORM}{quote}")


def _unit(value: object) -> int:
    if type(value) is int and 0 <= value <= 255:
        return value
    raise ValueError(f"found {show(value)}, allowed: a unit id from 0 to 255")


def _object(value: object) -> int:
    if type(value) is int and 128 <= value <= 255:
        return value
    raise ValueError(f"found {show(value)}, allowed: an object id from 128 to 255")


def _function(value: object) -> int:
    if type(value) is int and value in FUNCTIONS:
        return value
    raise ValueError(f"found {show(value)}, allowed: {choice(FUNCTIONS)}")


def _text(value: object) -> str:
    allowed = f"allowed: text of 1 to {MOST_BYTES} bytes"
    if not isinstance(value, str):
        quote = f"; write '{value}' to make it text" if isinstance(value, int | float) else ""
        raise ValueError(f"found {show(value)}, {allowed}{quote}")
    for character in value:
        if unicodedata.category(character) in ("Cc", "Cs"):
            raise ValueError(f"found {show(value)}, allowed: text without {character!r}")
    size = len(value.encode())
    if not 1 <= size <= MOST_BYTES:
        raise ValueError(f"found text of {size} bytes, {allowed}")
    return value


def _no_instant(value: float) -> float:
    if 0 < value < SHORTEST_TIME:
        raise ValueError(f"found {value}, allowed: 0, or {SHORTEST_TIME} to {LONGEST_TIME} seconds")
    return value


def _not_null(value: object) -> object:
    if value is None:
        raise PydanticCustomError("null", "nothing")
    return value


def _whole(value: float) -> int | float:
    return int(value) if value.is_integer() else value


class NotNull:
    """For a key that can be left out, but not be empty: `None` is its default and nothing else."""

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_before_validator_function(_not_null, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        made = handler(schema)
        kinds = [kind for kind in made.get("anyOf", []) if kind != {"type": "null"}]
        if len(kinds) == 1:
            del made["anyOf"]
            made.update(kinds[0])
        elif kinds:
            made["anyOf"] = kinds
        return made


Name = Annotated[
    str,
    PlainValidator(_name),
    WithJsonSchema({"type": "string", "pattern": f"^{_NAME}$"}),
]
UnitId = Annotated[int, PlainValidator(_unit), WithJsonSchema({"type": "integer"})]
ObjectId = Annotated[int, PlainValidator(_object), WithJsonSchema({"type": "integer"})]
Text = Annotated[
    str,
    PlainValidator(_text),
    WithJsonSchema({"type": "string", "minLength": 1, "maxLength": MOST_BYTES}),
]
Source = Annotated[
    Network,
    PlainValidator(parse_source),
    PlainSerializer(str, return_type=str),
    WithJsonSchema({"type": "string", "examples": ["10.0.0.0/24", "10.0.0.7", "fd00::/64"]}),
]
BindAddress = Annotated[
    Bind,
    PlainValidator(parse_bind),
    PlainSerializer(str, return_type=str),
    WithJsonSchema({"type": "string", "examples": ["0.0.0.0:502", "127.0.0.1:5020", "[::]:502"]}),
]
Duration = Annotated[
    float,
    Field(ge=SHORTEST_TIME, le=LONGEST_TIME, allow_inf_nan=False),
    PlainSerializer(_whole, return_type=int | float),
]
DurationOrZero = Annotated[
    float,
    Field(ge=0, le=LONGEST_TIME, allow_inf_nan=False),
    AfterValidator(_no_instant),
    PlainSerializer(_whole, return_type=int | float),
]
FunctionCode = Annotated[
    int,
    PlainValidator(_function),
    WithJsonSchema({"type": "integer", "enum": list(FUNCTIONS)}),
]
Codes = Annotated[
    tuple[FunctionCode, ...], Strict(False), Field(json_schema_extra={"uniqueItems": True})
]

NAME_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_NAME}$"}}
UNIT_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_BYTE}$"}}
OBJECT_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_HIGH_BYTE}$"}}
"""What a schema says of the keys of a mapping, which are text to it."""
