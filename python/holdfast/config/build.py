"""Builds the models from plain data, and translates pydantic's errors.

Each error becomes one message: what was found, and what is allowed.
"""

from __future__ import annotations

import re
from itertools import islice, pairwise
from math import inf
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from holdfast.config.allowed_words import allowed, known_keys
from holdfast.config.models.listeners import LISTENER_TYPES, UNIT_TAGS
from holdfast.config.models.outputs import OUTPUT_TYPES
from holdfast.config.models.partial import partial
from holdfast.config.models.root import Config
from holdfast.config.text.messages import foreign_space, shape, show
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import either, listing
from holdfast.runtime.time_units import seconds_in
from holdfast.tags.text import decimal_comma
from holdfast.types import KNOWN_AREAS

if TYPE_CHECKING:
    from pathlib import Path

    from pydantic_core import ErrorDetails

    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath

_KEY = "[key]"
_NO_KIND = ("union_tag_invalid", "union_tag_not_found")
_TOKENS = (("rest", "tokens"), ("gateway", "tokens"))
_URLS = (("servers",), ("monitoring",))
"""The keys of lists of URLs, which can contain passwords."""
_CONSEQUENCES = ("default_factory_not_called",)
"""Errors that are only consequences of other errors."""


def build(data: object, folder: Path, report: Report) -> Config:
    """Builds a `Config`; from invalid data its valid part, and reports problems.

    Files are relative to `folder`.
    """
    context = {"folder": folder}
    try:
        return Config.model_validate(data, context=context)
    except ValidationError as errors:
        for error in errors.errors(include_url=False):
            _add(_untagged(error["loc"]), error, report)
        return partial(data, context)


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
    if kind in _CONSEQUENCES or (kind == "too_short" and error["input"]):
        return  # The error inside the value has its own report.
    if kind in _NO_KIND:
        _add_kind((*path, "type"), error["input"], report)
    elif kind == "missing":
        report.add_key(path, f"missing, allowed: {allowed(path, data)}")
    elif kind in ("extra_forbidden", "invalid_key"):
        _add_unknown(path, report)
    elif kind == "problem_at":
        context = error["ctx"]
        where = (*path, context["key"]) if context["key"] else path
        report.add(where, context["message"])
    elif kind == "value_error":
        report.add(path, str(error["ctx"]["error"]), of_key=of_key)
    else:
        while not report.document.holds(path):
            path = path[:-1]
        near = _near(error) if kind == "literal_error" else ""
        words = "an integer" if of_key and kind == "int_type" else f"{allowed(path, data)}{near}"
        words += _in_seconds(error["input"], words)
        found = _shown(path, error["input"])
        comma = decimal_comma(str(error["input"])) if words.startswith("a number") else None
        message = f"found {found}, allowed: {words}" if comma is None else f"{found} {comma}"
        report.add(path, message)


def _near(error: ErrorDetails) -> str:
    """The word that was probably meant."""
    words, found = _words(error), error["input"]
    area = KNOWN_AREAS.get(str(found).lower())
    return suggestion(area if area in words else found, words)


def _words(error: ErrorDetails) -> list[str]:
    """The words that a literal allows."""
    return re.findall("'([^']*)'", error["ctx"]["expected"])


def _in_seconds(found: object, words: str) -> str:
    """The number that a time with a unit probably means."""
    if not isinstance(found, str) or re.match("a number .* seconds", words) is None:
        return ""
    number = seconds_in(found)
    return "" if number is None or number == inf else f"; did you mean {number:.12g}?"


def _add_kind(path: KeyPath, owner: dict[str, Any], report: Report) -> None:
    types = OUTPUT_TYPES if path[0] == "outputs" else LISTENER_TYPES
    words = f"allowed: {either(types)}"
    if "type" not in owner:
        known = known_keys(path[:-1], report.document.data)
        meant = {key: suggestion(key, ["type"]) for key in owner if key not in known}
        for key in filter(meant.get, meant):
            report.add_key((*path[:-1], key), f"unknown key, allowed: type{meant[key]}")
        if not any(meant.values()):
            report.add_key(path, f"missing, {words}")
    else:
        near = suggestion(owner["type"], types)
        report.add(path, f"found {show(owner['type'])}, {words}{near}")


def _shown(path: KeyPath, value: object) -> str:
    """The value as text, or only its shape if it could contain a secret."""
    of_token = path[:2] in _TOKENS and len(path) <= 3
    return shape(value) if of_token or path[-1:] in _URLS else show(value)


def _add_unknown(path: KeyPath, report: Report) -> None:
    key = path[-1]
    known = known_keys(path[:-1], report.document.data)
    if (blank := foreign_space(str(key))) is not None:
        report.add_key(path, f"found {blank} before the key, allowed: spaces")
    elif isinstance(key, int) and (cut := _cut_number(path, report, len(known))) is not None:
        found = f"found a comma behind {report.raw(cut)}"
        report.add_final(cut, f"{found}, allowed: numbers such as 0.1 and 1000")
    else:
        words = f"allowed: {listing(known)}{suggestion(key, known)}"
        report.add_key(path, f"unknown key, {words}")


def _cut_number(path: KeyPath, report: Report, known: int) -> KeyPath | None:
    """The number behind whose comma in brackets this key stands: `{scale: 0,1}`."""
    document, owner = report.document, path[:-1]
    if not document.holds(path) or report.raw(path) is not None:
        return None
    # A mapping of known keys, each of which has a comma, has twice as many.
    for before, key in pairwise(islice(report.raw(owner), 2 * known)):
        if key == path[-1] and type(number := report.raw((*owner, before))) is int:
            start, end = document.place((*owner, before)), document.place(path, of_key=True)
            length = end.column - start.column - len(",") if end.line == start.line else 0
            # Between two entries of a mapping, there is a space. A 0 may be written as -0.
            is_cut = length == len(str(number)) or (number, length) == (0, len("-0"))
            return (*owner, before) if is_cut else None
    return None
