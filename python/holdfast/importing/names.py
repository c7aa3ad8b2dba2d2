"""Converts names of the source to unique names that a configuration allows."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from holdfast.config.values.scalars import NAME_FORM

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk

MAX_LENGTH = 64


def unique_names(desk: Desk, wanted: Sequence[tuple[KeyPath, str]]) -> list[str]:
    """A unique, allowed name for each wanted name; keeps wanted names where possible."""
    texts = [text for _, text in wanted]
    taken = {text for text in texts if _allowed(text) == text}
    given: list[str] = []
    for index, (path, text) in enumerate(wanted):
        name = text
        if text not in taken or text in texts[:index]:
            name = free_name(_allowed(text), taken)
            taken.add(name)
            reason = "the name is in use" if text in texts[:index] else f"a name has {NAME_FORM}"
            desk.changed(path, f"renamed to {name}: {reason}")
        given.append(name)
    return given


def _allowed(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text)[:MAX_LENGTH] or "_"


def free_name(name: str, taken: set[str]) -> str:
    """The name, followed by a number if it is taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name[: MAX_LENGTH - len(str(number)) - 1]}-{number}"
    return free
