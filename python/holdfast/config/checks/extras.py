"""Checks that the packages are installed that sections and outputs require."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.checks.common import items
from holdfast.runtime import extras

if TYPE_CHECKING:
    from holdfast.config.checks.common import Scope
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.runtime.extras import Extra

SECTIONS: dict[str, Extra] = {"logs": "nats", "mqtt": "mqtt", "nats": "nats"}
OUTPUTS: dict[str, Extra] = {"mqtt": "mqtt", "nats": "nats", "sparkplug": "sparkplug"}
"""The extra that a section, and a type of outputs, requires."""


def check_extras(scope: Scope) -> None:
    """Reports what this installation can't run because an extra is missing."""
    for section, extra in SECTIONS.items():
        if scope.config.__dict__.get(section):
            _check(scope, (section,), section, extra)
    for path, output in items(("outputs",), scope.config.__dict__.get("outputs", {})):
        kind = output.__dict__.get("type")
        if kind in OUTPUTS:
            _check(scope, (*path, "type"), f"'{kind}'", OUTPUTS[kind])


def _check(scope: Scope, path: KeyPath, found: str, extra: Extra) -> None:
    reason = extras.missing(extra)
    if reason is not None:
        scope.report.add(path, f"found {found}, which {reason}", of_key=len(path) == 1)
