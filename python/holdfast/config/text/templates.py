"""Expands devices that are written once for many: `for: {n: 1-300}`.

`{n}` in the name and in all text of such a device stands for each number in turn; `{n:03}` has at
least three digits. A text that is nothing but `{n}` becomes the number.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from holdfast.config.text.messages import show
from holdfast.config.text.raw_access import mapping
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath

MAX_EXPANDED_DEVICES = 10_000
"""The most devices of a file with `for`. Without `for`, their number has no limit."""

_FIELD = re.compile(r"\{([A-Za-z_][A-Za-z0-9_]*)(?::(0[1-9]))?\}")
_BRACES = re.compile(r"\{([^{}]*)\}")
_SPAN = re.compile(r"([0-9]{1,9})-([0-9]{1,9})")
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_ALLOWED = "allowed: as in {n: 1-300} or {n: [1, 2, 5]}"


def expand_templates(report: Report) -> None:
    """Replaces each device with `for` in the document of a report by its devices."""
    document = report.document
    devices = mapping(mapping(document.data).get("devices"))
    if not any("for" in mapping(device) for device in devices.values()):
        return
    made: dict[Any, Any] = {}
    places = document.root.children["devices"][1].children
    for name, device in devices.items():
        path: KeyPath = ("devices", name)
        if "for" not in mapping(device):
            _keep(report, made, name, device, path)
            continue
        for values in _values(report, path, device["for"]):
            plain = {key: value for key, value in device.items() if key != "for"}
            try:
                named = str(_filled(name, values))
                content = _filled(plain, values)
            except KeyError as error:
                known = listing(f"{{{each}}}" for each in values)
                padded = f"{{{next(iter(values))}:03}} for at least three digits"
                report.add_key(path, f"found {{{error.args[0]}}}, allowed: {known}, {padded}")
                break
            if len(made) >= MAX_EXPANDED_DEVICES:
                message = f"the file would have more than {MAX_EXPANDED_DEVICES} devices"
                report.add((*path, "for"), f"{message}, allowed: up to {MAX_EXPANDED_DEVICES}")
                break
            places.setdefault(named, places[name])
            report.templates[named] = name
            _keep(report, made, named, content, path)
    report.document = replace(document, data={**document.data, "devices": made})


def _keep(report: Report, made: dict[Any, Any], name: object, device: Any, path: KeyPath) -> None:
    if name in made:
        report.add_key(path, f"a second device has the name {show(name)}")
    else:
        made[name] = device


def _values(report: Report, path: KeyPath, given: object) -> list[dict[str, int]]:
    """All combinations of the variables of a device."""
    path = (*path, "for")
    if not isinstance(given, dict) or not given:
        report.add(path, f"found {show(given)}, {_ALLOWED}")
        return []
    numbers = []
    for variable, span in given.items():
        if not isinstance(variable, str) or _VARIABLE.fullmatch(variable) is None:
            report.add_key((*path, variable), f"found {show(variable)}, {_ALLOWED}")
            return []
        found = _numbers(span)
        if found is None:
            report.add((*path, variable), f"found {show(span)}, {_ALLOWED}")
            return []
        numbers.append(found)
    combined = itertools.islice(itertools.product(*numbers), MAX_EXPANDED_DEVICES + 1)
    return [dict(zip(given, each, strict=True)) for each in combined]


def _numbers(span: object) -> range | list[int] | None:
    if type(span) is int and span >= 0:
        return [span]
    if isinstance(span, list) and span and all(type(each) is int and each >= 0 for each in span):
        return span
    match = _SPAN.fullmatch(span) if isinstance(span, str) else None
    if match is None or int(match[1]) > int(match[2]):
        return None
    first, last = int(match[1]), int(match[2])
    return range(first, min(last, first + MAX_EXPANDED_DEVICES) + 1)


def _filled(value: Any, values: Mapping[str, int]) -> Any:
    """A value with the numbers in all its text. Raises `KeyError` for an unknown variable, and for
    a known one in another form.
    """
    if isinstance(value, str):
        whole = _FIELD.fullmatch(value)
        if whole is not None and whole[2] is None:
            return values[whole[1]]
        filled = _FIELD.sub(lambda found: f"{values[found[1]]:{found[2] or 'd'}}", value)
        for inside in _BRACES.findall(filled) if "{" in filled else ():
            if not values.keys().isdisjoint(_VARIABLE.findall(inside)):
                raise KeyError(inside)
        return filled
    if isinstance(value, list):
        return [_filled(each, values) for each in value]
    if isinstance(value, dict):
        return {_filled(key, values): _filled(each, values) for key, each in value.items()}
    return value
