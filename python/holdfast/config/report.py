"""Collects the problems of one file, each with its place. It does not check values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.config.problems import Problem

if TYPE_CHECKING:
    from holdfast.config.source import Document, Key, KeyPath


@dataclass
class Report:
    """The problems found so far in one document, each once, and the warnings (`doubts`)."""

    document: Document
    found: dict[Problem, None] = field(default_factory=dict)
    doubts: list[Problem] = field(default_factory=list)
    settled: list[KeyPath] = field(default_factory=list)
    templates: dict[Key, Key] = field(default_factory=dict)
    """The names of devices that are written once for many, by the name of each of them."""

    @property
    def problems(self) -> list[Problem]:
        """The problems, in the order they were found."""
        return list(self.found)

    def add(self, path: KeyPath, message: str, *, of_key: bool = False) -> None:
        """Adds a problem with the value at `path`, or with the key itself."""
        problem = self._at(path, message, of_key)
        if not (self._of_many(path) and any(_alike(problem, other) for other in self.found)):
            self.found[problem] = None

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
        problem = self._at(path, message, of_key=False)
        if not (self._of_many(path) and any(_alike(problem, other) for other in self.doubts)):
            self.doubts.append(problem)

    def _of_many(self, path: KeyPath) -> bool:
        """Whether a path is in a device that is written once for many."""
        return path[:1] == ("devices",) and path[1:2] != () and path[1] in self.templates

    def _at(self, path: KeyPath, message: str, of_key: bool) -> Problem:
        place = self.document.place(path, of_key=of_key)
        if self._of_many(path):
            path = ("devices", self.templates[path[1]], *path[2:])
        key = self.document.spell(path)
        return Problem(self.document.file, place.line, place.column, key, message)

    def line(self, path: KeyPath) -> int:
        """The line of the key at `path`."""
        return self.document.place(path, of_key=True).line


def _alike(one: Problem, other: Problem) -> bool:
    """Whether two problems are at the same place of the file."""
    return (one.line, one.column, one.key) == (other.line, other.column, other.key)
