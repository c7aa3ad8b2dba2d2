"""Checks that values are unique in a list, or in a whole file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.config.words import show

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


def refuse_repeats(path: KeyPath, values: Iterable[object], report: Report) -> None:
    """Reports every text or integer that repeats an earlier entry of the list."""
    seen: set[str | int] = set()
    for index, value in enumerate(values):
        if not isinstance(value, str) and type(value) is not int:
            continue
        if value in seen:
            report.add((*path, index), f"found {show(value)} again, allowed: once")
        seen.add(value)


@dataclass
class Owners:
    """The first owner of each value, for values that must be unique."""

    report: Report
    what: str
    """What the value is, as messages call it."""
    first: dict[object, KeyPath] = field(default_factory=dict)

    def claim(self, path: KeyPath, value: object, shown: str, owner: KeyPath) -> None:
        """Reports `value` at `path` if another owner has it; messages call it `shown`."""
        if value not in self.first:
            self.first[value] = owner
            return
        other = self.first[value]
        of = f"{self.report.document.spell(other)} in line {self.report.line(other)}"
        message = f"found {shown}, which is the {self.what} of {of}, allowed: a different one"
        self.report.add(path, message)
