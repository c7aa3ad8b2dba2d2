"""Converts names of the source to unique names that a configuration allows."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from holdfast.config.values.scalars import NAME_FORM

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk

MAX_LENGTH = 64


def unique_names(
    desk: Desk, wanted: Sequence[tuple[KeyPath, str]], reserved: Collection[str] = ()
) -> list[str]:
    """A unique, allowed name for each wanted name; keeps wanted names where possible.

    `reserved` are names that none may have.
    """
    texts = [text for _, text in wanted]
    kept = {text for text in texts if allowed_name(text) == text}.difference(reserved)
    taken = kept.union(reserved)
    given: list[str] = []
    for index, (path, text) in enumerate(wanted):
        name = text
        if text not in kept or text in texts[:index]:
            name = free_name(allowed_name(text), taken)
            taken.add(name)
            reason = "the name is in use" if text in texts[:index] else f"a name has {NAME_FORM}"
            if text in reserved:
                reason = "the name has another meaning in logs"
            desk.changed(path, f"renamed to {name}: {reason}")
        given.append(name)
    return given


def named_tags(
    desk: Desk, wanted: Sequence[tuple[KeyPath, str, dict[str, Any]]]
) -> dict[str, dict[str, Any]]:
    """The tags by unique, allowed names; one that is renamed has the wanted name as description."""
    names = unique_names(desk, [(path, text) for path, text, _ in wanted])
    return {
        name: tag if name == text else {**tag, "description": text}
        for name, (_, text, tag) in zip(names, wanted, strict=True)
    }


def allowed_name(text: str) -> str:
    """The name that a configuration allows and that is most like a text."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text)[:MAX_LENGTH] or "_"


def free_name(name: str, taken: set[str]) -> str:
    """The name, followed by a number if it is taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name[: MAX_LENGTH - len(str(number)) - 1]}-{number}"
    return free
