"""Values that may come once only: in one list, or anywhere in a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.config.words import show

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


def refuse_repeats(path: KeyPath, values: Iterable[object], report: Report) -> None:
    """Reports every text or integer of a list that came before in it."""
    seen: set[str | int] = set()
    for index, value in enumerate(values):
        if not isinstance(value, str) and type(value) is not int:
            continue
        if value in seen:
            report.add((*path, index), f"found {show(value)} again, allowed: once")
        seen.add(value)


@dataclass
class Owners:
    """Who has a value first, for values that no two may share."""

    report: Report
    what: str
    """What the value is to its owner."""
    first: dict[object, KeyPath] = field(default_factory=dict)

    def claim(self, path: KeyPath, value: object, shown: str, owner: KeyPath) -> None:
        """Reports `value` at `path` when another owner has it; `shown` is how to name it."""
        if value not in self.first:
            self.first[value] = owner
            return
        other = self.first[value]
        of = f"{self.report.document.spell(other)} in line {self.report.line(other)}"
        self.report.add(path, f"found {shown}, which is the {self.what} of {of}, allowed: another")
