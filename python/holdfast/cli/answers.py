"""The errors of commands with `--json`: objects of the shape that docs/cli.md describes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Mapping

TARGETS = ("file", "files", "url", "target", "targets", "receiver", "fleet")
"""The parameters of commands that say what they talk to; a URL beside a file is an option."""

_COMMAND = f"{__name__}.command"
"""The place in `meta` of the context of the command that has `--json`."""


def note_wanted(context: click.Context, _: click.Parameter, as_json: bool) -> bool:
    """Takes the value of `--json`. The context is kept: an interruption ends it, and is reported
    after that.
    """
    if as_json:
        context.meta[_COMMAND] = context
    return as_json


def wanted() -> bool:
    """Whether the command that runs has `--json`."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.params.get("as_json"))


def print_wrong(
    reason: str, detail: object, target: object = None, more: Mapping[str, object] | None = None
) -> None:
    """Prints an error. Default for the target: that of the command, as it was given."""
    target = _target() if target is None else str(target)
    text = str(detail).removeprefix(f"{target}: ")
    whose = {} if target is None else {"target": target}
    answer = {"ok": False, **whose, "reason": reason, "detail": text, **(more or {})}
    click.echo(json.dumps(answer))


def first_of(errors: Mapping[str, Mapping[str, object]]) -> dict[str, object]:
    """The error of an answer in which several values have one: the first, with its name."""
    for name, error in errors.items():
        return {**error, "detail": f"{name}: {error['detail']}"}
    return {}


def _target() -> str | None:
    context = click.get_current_context(silent=True)
    given = {} if context is None else context.meta.get(_COMMAND, context).params
    for name in TARGETS:
        if given.get(name):
            value = given[name]
            return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return None
