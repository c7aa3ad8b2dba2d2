"""The fields of requests. One definition serves JSON, queries and the OpenAPI document.

Nothing is converted: an integer has no fraction or exponent. Unknown fields are refused, so that a
misspelled field never falls back to its default.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import msgspec

from holdfast.net.http.requests import BadRequest, shown
from holdfast.net.http.schemas import Schema, object_of
from holdfast.runtime.text import all_of, would_be_zero

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

REQUIRED: Any = object()
"""The default of a required field."""

MORE_PARAMETERS = 4
"""Parameters that are read in excess of the allowed ones, for an error that names the wrong one."""


@dataclass(frozen=True)
class Field:
    """A field. It is required if `default` is `REQUIRED`; `None` means optional without default."""

    name: str
    schema: Schema
    text: str
    default: Any = REQUIRED
    refusal: Callable[[Any], str] | None = None
    """Returns the error message for a wrong value; `None` for the default message."""
    allowed: str = ""
    """The allowed values for error messages; empty to use the schema."""
    fits: Callable[[Any], bool] = lambda _: True
    """Additional check of a value that fits the schema."""
    example: Any = None
    """A value for the OpenAPI document, if it is not the default."""
    most: int = 1
    """How often a parameter may be given. With more than once, its value is a list."""

    def check(self, value: Any) -> Any:
        """Returns the value if it is valid. Raises `BadRequest`."""
        flaw = _flaw(value, self.schema)
        if flaw is None and self.fits(value):
            return value
        if self.allowed:
            flaw = f" is {value_text(value)}, allowed: {self.allowed}"
        raise malformed(f"{self.name}{flaw}" if self.refusal is None else self.refusal(value))

    def read(self, text: str) -> Any:
        """Parses and checks a value from a query. Raises `BadRequest`."""
        kind = self.schema.get("type")
        if kind == "integer" and re.fullmatch("(0|[1-9][0-9]{0,9})", text):
            return self.check(int(text))
        return self.check(text)

    @staticmethod
    def missing(missing: Sequence[str], required: Sequence[str]) -> str:  # noqa: ARG004
        """Returns the error message for required fields that are missing."""
        return f"Missing required parameter{'s'[: len(missing) > 1]}: {all_of(missing)}"

    @property
    def required(self) -> bool:
        """Whether the field is required."""
        return self.default is REQUIRED

    @property
    def typed(self) -> Schema:
        """The schema with the default."""
        whole: Schema = self.schema
        if self.most > 1:
            whole = {"type": "array", "minItems": 1, "items": self.schema}
        if self.required or self.default is None:
            return whole
        return {**whole, "default": self.default}


def object_with(fields: Sequence[Field]) -> Schema:
    """The schema of an object with these fields."""
    properties = {field.name: {**field.typed, "description": field.text} for field in fields}
    return object_of(properties, optional=[each.name for each in fields if not each.required])


class NotJson(BadRequest):
    """A body is not JSON."""


def from_json(body: bytes, fields: Sequence[Field]) -> dict[str, Any]:
    """Parses the fields of a JSON object and fills in defaults. Raises `BadRequest`."""
    value = decoded(body)
    if not isinstance(value, dict):
        raise malformed("the body is not a JSON object")
    return filled(value, fields)


def decoded(body: bytes) -> Any:
    """Parses JSON. Raises `NotJson`, and `BadRequest` for a duplicate name."""
    try:
        text = body.decode()
        value = _DECODER.decode(text)
        if "\\u" in text:
            msgspec.json.decode(body)  # `json` lets half of a surrogate pair through.
        return value
    except msgspec.MsgspecError:
        detail = "a string has half of a surrogate pair"
    except (RecursionError, ValueError) as error:
        detail = str(error)[:100]
    raise NotJson("malformed", f"the body is not JSON: {detail}")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Returns an object. Raises `BadRequest` for a duplicate name."""
    found = dict(pairs)
    if len(found) < len(pairs):
        [(twin, _)] = Counter(name for name, _ in pairs).most_common(1)
        raise malformed(f"{shown(twin)} is given more than once")
    return found


def _float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value) or would_be_zero(text):
        raise ValueError(f"{text[:40]} is out of range")
    return value


def _integer(text: str) -> int:
    digits, most = len(text.lstrip("-")), sys.get_int_max_str_digits()
    if 0 < most < digits:  # 0 is no limit.
        raise ValueError(f"an integer has {digits} digits, allowed: {most}")
    return int(text)


_DECODER = json.JSONDecoder(
    object_pairs_hook=_without_duplicates,
    parse_float=_float,
    parse_int=_integer,
    parse_constant=_float,
)


def from_query(query: bytes, fields: Sequence[Field]) -> dict[str, Any]:
    """Parses the fields of a query and fills in defaults. Raises `BadRequest`."""
    known = {field.name: field for field in fields}
    most = sum(field.most for field in fields) + MORE_PARAMETERS
    try:
        pairs = parse_qsl(query.decode("latin-1"), keep_blank_values=True, max_num_fields=most)
    except ValueError:
        raise malformed(f"more than {most} parameters, allowed: {', '.join(known)}") from None
    texts: dict[str, list[str]] = {}
    for name, text in pairs:
        texts.setdefault(name, []).append(text)
    for name, copies in texts.items():
        if name in known and len(copies) > (limit := known[name].most):
            times = "once" if limit == 1 else f"{limit} times"
            raise malformed(f"{name} is given more than {times}")
    _check_names(texts, fields)
    values: dict[str, Any] = {field.name: field.default for field in fields}
    for name, copies in texts.items():
        read = [known[name].read(text) for text in copies]
        values[name] = read if known[name].most > 1 else read[0]
    return values


def malformed(detail: str) -> BadRequest:
    """Creates the error for a malformed request."""
    return BadRequest("malformed", detail)


def filled(given: Mapping[str, Any], fields: Sequence[Field]) -> dict[str, Any]:
    """Checks the fields of an object and fills in defaults. Raises `BadRequest`."""
    _check_names(given, fields)
    return {
        field.name: field.check(given[field.name]) if field.name in given else field.default
        for field in fields
    }


def _check_names(given: Iterable[str], fields: Sequence[Field]) -> None:
    """Raises `BadRequest` for a field that is missing or unknown."""
    required = [field.name for field in fields if field.required]
    missing = [name for name in required if name not in given]
    if missing:
        raise malformed(fields[0].missing(missing, required))
    names = [field.name for field in fields]
    for name in given:
        if name not in names:
            raise malformed(f"{shown(name)} is not a parameter, allowed: {', '.join(names)}")


def _flaw(value: Any, schema: Schema) -> str | None:
    """Returns the error message after the value's name; `None` for a valid value."""
    kind = schema.get("type")
    if kind == "array":
        return _flaw_of_array(value, schema)
    if "enum" in schema:
        allowed = schema["enum"]
        fits = any(type(value) is type(each) and value == each for each in allowed)
        return None if fits else f" is {value_text(value)}, allowed: {_words(allowed)}"
    if kind == "integer":
        least, most = schema["minimum"], schema["maximum"]
        fits = type(value) is int and least <= value <= most
        return None if fits else f" is {value_text(value)}, allowed: an integer {least} to {most}"
    if kind == "boolean":
        return None if type(value) is bool else f" is {value_text(value)}, allowed: true and false"
    if kind != "string":
        return None
    fits = isinstance(value, str) and re.fullmatch(schema.get("pattern", ".*"), value) is not None
    least, most = schema.get("minLength", 0), schema.get("maxLength", math.inf)
    long = isinstance(value, str) and not least <= len(value) <= most
    return f" is {value_text(value)}, which is not valid" if long or not fits else None


def _flaw_of_array(value: Any, schema: Schema) -> str | None:
    if not isinstance(value, list):
        return f" is {value_text(value)}, allowed: an array"
    least, most = schema["minItems"], schema["maxItems"]
    if not least <= len(value) <= most:
        return f" has {len(value)} elements, allowed: {least} to {most}"
    if schema.get("uniqueItems") and any(value.count(each) > 1 for each in value):
        return " has duplicate elements"
    for index, item in enumerate(value):
        flaw = _flaw(item, schema["items"])
        if flaw is not None:
            return f"[{index}]{flaw}"
    return None


def value_text(value: Any) -> str:
    """Formats an untrusted value, cut to a limited length."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "an array"
    text = msgspec.json.encode(value).decode() if type(value) is not int else str(value)[:40]
    return text[:40]


def _words(allowed: Sequence[Any]) -> str:
    return ", ".join(each if isinstance(each, str) else value_text(each) for each in allowed)
