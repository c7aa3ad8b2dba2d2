"""Collects the problems of one file, each with its place. It does not check values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.config.problems import Problem

if TYPE_CHECKING:
    from holdfast.config.source import Document, KeyPath


@dataclass
class Report:
    """The problems found so far in one document, each once, and the warnings (`doubts`)."""

    document: Document
    found: dict[Problem, None] = field(default_factory=dict)
    doubts: list[Problem] = field(default_factory=list)
    settled: list[KeyPath] = field(default_factory=list)

    @property
    def problems(self) -> list[Problem]:
        """The problems, in the order they were found."""
        return list(self.found)

    def add(self, path: KeyPath, message: str, *, of_key: bool = False) -> None:
        """Adds a problem with the value at `path`, or with the key itself."""
        self.found[self._at(path, message, of_key)] = None

    def settle(
        self, path: KeyPath, message: str, part: KeyPath = (), *, of_key: bool = False
    ) -> None:
        """Adds the only problem of `path`, at a part of it; other problems there are ignored."""
        self.add((*path, *part), message, of_key=of_key)
        self.settled.append(path)

    def is_settled(self, path: KeyPath) -> bool:
        """Whether `settle` already reported the only problem of `path`."""
        return any(path[: len(settled)] == settled for settled in self.settled)

    def doubt(self, path: KeyPath, message: str) -> None:
        """Adds a warning: a valid setting at `path` that has no effect, or probably a wrong one."""
        self.doubts.append(self._at(path, message, of_key=False))

    def _at(self, path: KeyPath, message: str, of_key: bool) -> Problem:
        place = self.document.place(path, of_key=of_key)
        key = self.document.spell(path)
        return Problem(self.document.file, place.line, place.column, key, message)

    def line(self, path: KeyPath) -> int:
        """The line of the key at `path`."""
        return self.document.place(path, of_key=True).line
