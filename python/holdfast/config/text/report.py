"""Collects the problems of one file, each with its place. It does not check values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.config.text.problems import Problem

if TYPE_CHECKING:
    from holdfast.config.text.yaml_document import Document, Key, KeyPath


@dataclass
class Report:
    """The problems found so far in one document, each once, and the warnings."""

    document: Document
    found: dict[Problem, KeyPath] = field(default_factory=dict)
    warnings: list[Problem] = field(default_factory=list)
    final: set[KeyPath] = field(default_factory=set)
    elsewhere: list[Problem] = field(default_factory=list)
    """The problems of files that the document names."""
    templates: dict[Key, Key] = field(default_factory=dict)
    """The names of devices that are written once for many, by the name of each of them."""

    @property
    def problems(self) -> list[Problem]:
        """The problems, in the order they were found."""
        return list(self.found)

    def add(self, path: KeyPath, message: str, *, of_key: bool = False) -> None:
        """Adds a problem with the value at `path`, or with the key itself, unless it is final."""
        if path in self.final:
            return
        problem = self._at(path, message, of_key)
        if not (self._of_many(path) and any(_alike(problem, other) for other in self.found)):
            self.found.setdefault(problem, path)

    def add_key(self, path: KeyPath, message: str) -> None:
        """Adds a problem with the key at `path` itself, such as a missing one."""
        self.add(path, message, of_key=True)

    def add_final(self, path: KeyPath, message: str, *, of_key: bool = False) -> None:
        """Adds the only problem of `path`, in place of others there."""
        for problem, where in list(self.found.items()):
            if where[: len(path)] == path:
                del self.found[problem]
        self.final.discard(path)
        self.add(path, message, of_key=of_key)
        self.final.add(path)

    def warn(self, path: KeyPath, message: str) -> None:
        """Adds a warning: a valid setting at `path` that has no effect, or probably a wrong one."""
        problem = self._at(path, message, of_key=False)
        if not (self._of_many(path) and any(_alike(problem, other) for other in self.warnings)):
            self.warnings.append(problem)

    def _of_many(self, path: KeyPath) -> bool:
        """Whether a path is in a device that is written once for many."""
        return path[:1] == ("devices",) and path[1:2] != () and path[1] in self.templates

    def _at(self, path: KeyPath, message: str, of_key: bool) -> Problem:
        place = self.document.place(path, of_key=of_key)
        if self._of_many(path):
            path = ("devices", self.templates[path[1]], *path[2:])
        key = self.document.spell(path)
        return Problem(place.file, place.line, place.column, key, message)

    def raw(self, path: KeyPath) -> Any:
        """The value at `path` as it is in the file."""
        value = self.document.data
        for key in path:
            value = value[key]
        return value

    def named(self, path: KeyPath) -> str:
        """A place of the file, for the message of another: `listeners.scada in line 7`."""
        return f"{self.document.spell(path)} in line {self.line(path)}"

    def line(self, path: KeyPath) -> int:
        """The line of the key at `path`."""
        return self.document.place(path, of_key=True).line


def _alike(one: Problem, other: Problem) -> bool:
    """Whether two problems are at the same place of the file."""
    return (one.line, one.column, one.key) == (other.line, other.column, other.key)
