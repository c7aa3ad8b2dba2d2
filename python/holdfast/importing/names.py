"""Names that a configuration of ours allows, for things that the source names more freely."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from holdfast.config.scalars import NAME_FORM

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.source import KeyPath
    from holdfast.importing.notes import Desk

MAX_LENGTH = 64


def unique_names(desk: Desk, wanted: Sequence[tuple[KeyPath, str]]) -> list[str]:
    """An allowed name for each wanted one, no two alike; those that can stay as they are do."""
    texts = [text for _, text in wanted]
    taken = {text for text in texts if _allowed(text) == text}
    given: list[str] = []
    for index, (path, text) in enumerate(wanted):
        name = text
        if text not in taken or text in texts[:index]:
            name = free_name(_allowed(text), taken)
            taken.add(name)
            reason = "the name is taken" if text in texts[:index] else f"a name is {NAME_FORM}"
            desk.note("changed", path, f"is named {name}: {reason}")
        given.append(name)
    return given


def _allowed(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text)[:MAX_LENGTH] or "_"


def free_name(name: str, taken: set[str]) -> str:
    """The name, with a number behind it when it is taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name[: MAX_LENGTH - len(str(number)) - 1]}-{number}"
    return free
