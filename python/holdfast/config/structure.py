"""Builds the models from plain data, and translates pydantic's errors.

Each error becomes one message: what was found, and what is allowed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from holdfast.config.allowed import allowed, known_keys
from holdfast.config.listeners import LISTENER_TYPES, UNIT_TAGS
from holdfast.config.model import Config
from holdfast.config.outputs import OUTPUT_TYPES
from holdfast.config.words import shape, show
from holdfast.runtime.text import either, guess, listing

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic_core import ErrorDetails

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

_KEY = "[key]"
_NO_KIND = ("union_tag_invalid", "union_tag_not_found")
_TOKENS = (("rest", "tokens"), ("gateway", "tokens"))
_SERVERS = ("nats", "servers")
_TOLD = ("default_factory_not_called",)
"""Errors that are only consequences of other errors."""


def build(data: object, context: Mapping[str, Any], report: Report) -> Config | None:
    """Builds a `Config`, or returns `None` and reports problems, except at settled paths."""
    try:
        return Config.model_validate(data, context=dict(context))
    except ValidationError as errors:
        for error in errors.errors(include_url=False):
            path = _untagged(error["loc"])
            if not report.is_settled(path):
                _add(path, error, report)
        return None


def _untagged(path: KeyPath) -> KeyPath:
    """The path without the tags that pydantic inserts for discriminated unions."""
    of_listener = path[:1] == ("listeners",) and path[2:] != (_KEY,)
    of_output = path[:1] == ("outputs",) and path[2:] != (_KEY,)
    if of_listener or of_output or path[:2] in _TOKENS:
        path = path[:2] + path[3:]
    of_unit = of_listener and path[4:5] == ("units",) and path[6:7] and path[6] in UNIT_TAGS
    return path[:6] + path[7:] if of_unit else path


def _add(path: KeyPath, error: ErrorDetails, report: Report) -> None:
    kind, data = error["type"], report.document.data
    of_key = bool(path) and path[-1] == _KEY
    path = path[:-1] if of_key else path
    if kind in _TOLD or (kind == "too_short" and error["input"]):
        return  # The error inside the value has its own report.
    if kind in _NO_KIND:
        _add_kind((*path, "type"), error["input"], report)
    elif kind == "missing":
        report.add(path, f"missing, allowed: {allowed(path, data)}", of_key=True)
    elif kind in ("extra_forbidden", "invalid_key"):
        report.add(path, _unknown(path, data), of_key=True)
    elif kind == "value_error":
        report.add(path, str(error["ctx"]["error"]), of_key=of_key)
    else:
        while not report.document.holds(path):
            path = path[:-1]
        report.add(path, f"found {_shown(path, error['input'])}, allowed: {allowed(path, data)}")


def _add_kind(path: KeyPath, owner: dict[str, Any], report: Report) -> None:
    types = OUTPUT_TYPES if path[0] == "outputs" else LISTENER_TYPES
    words = f"allowed: {either(types)}"
    if "type" not in owner:
        report.add(path, f"missing, {words}", of_key=True)
    else:
        near = guess(owner["type"], types)
        report.add(path, f"found {show(owner['type'])}, {words}{near}")


def _shown(path: KeyPath, value: object) -> str:
    """The value as text, or only its shape if it could contain a secret."""
    of_token = path[:2] in _TOKENS and len(path) <= 3
    return shape(value) if of_token or path == _SERVERS else show(value)


def _unknown(path: KeyPath, data: object) -> str:
    known = known_keys(path[:-1], data)
    return f"unknown key, allowed: {listing(known)}{guess(path[-1], known)}"
