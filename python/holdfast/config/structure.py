"""Plain data to models, and pydantic's errors to our own words.

One message a mistake, in one form: what was found, and what is allowed there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from holdfast.config.allowed import allowed, known_keys
from holdfast.config.model import Config
from holdfast.config.words import guess, listing, show

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic_core import ErrorDetails

    from holdfast.config.problems import Report
    from holdfast.config.source import KeyPath

_KEY = "[key]"


def build(
    data: object, context: Mapping[str, Any], report: Report, skip: Sequence[KeyPath]
) -> Config | None:
    """The models of `data`, or `None` and what is wrong; what is below `skip` is not looked at."""
    try:
        return Config.model_validate(data, context=dict(context))
    except ValidationError as errors:
        for error in errors.errors(include_url=False):
            if not any(error["loc"][: len(path)] == path for path in skip):
                _add(error, report)
        return None


def _add(error: ErrorDetails, report: Report) -> None:
    path, kind = error["loc"], error["type"]
    of_key = bool(path) and path[-1] == _KEY
    path = path[:-1] if of_key else path
    if kind == "too_short" and error["input"]:
        return  # What is inside is wrong, and reported.
    if kind == "missing":
        report.add(path, f"missing, allowed: {allowed(path)}", of_key=True)
    elif kind in ("extra_forbidden", "invalid_key"):
        report.add(path, _unknown(path), of_key=True)
    elif kind == "value_error":
        report.add(path, str(error["ctx"]["error"]), of_key=of_key)
    else:
        while not report.document.holds(path):
            path = path[:-1]
        report.add(path, f"found {show(error['input'])}, allowed: {allowed(path)}")


def _unknown(path: KeyPath) -> str:
    known = known_keys(path[:-1])
    return f"unknown key, allowed: {listing(known)}{guess(path[-1], known)}"
