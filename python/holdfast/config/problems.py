"""What is wrong with a configuration: one `Problem` a mistake, all of them in one `ConfigError`.

A `Report` collects the problems of one file. Nothing here judges a value.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.source import Document, KeyPath


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake: where (line and column from 1, or `None` for all of a file) and what.

    `key` is the path of the key, as in `listeners.scada.rules[0].access`; empty at the top.
    """

    file: str
    line: int | None
    column: int | None
    key: str
    message: str

    def __str__(self) -> str:
        where = self.file if self.line is None else f"{self.file}:{self.line}"
        return ": ".join(part for part in (where, self.key, self.message) if part)


class ConfigError(Exception):
    """A configuration that can't be used, with all its `problems`: first those of the file itself
    in the order of its lines, then those of the files it names.
    """

    def __init__(self, file: str, problems: Iterable[Problem]) -> None:
        def order(problem: Problem) -> tuple[bool, str, int, int]:
            other = problem.file != file
            return (other, problem.file, problem.line or 0, problem.column or 0)

        self.problems: tuple[Problem, ...] = tuple(sorted(problems, key=order))
        super().__init__("\n".join(str(problem) for problem in self.problems))


@dataclass
class Report:
    """The problems found so far in one document, each once, and what is right but has no effect."""

    document: Document
    found: dict[Problem, None] = field(default_factory=dict)
    doubts: list[Problem] = field(default_factory=list)
    settled: list[KeyPath] = field(default_factory=list)

    @property
    def problems(self) -> list[Problem]:
        """In the order they were found."""
        return list(self.found)

    def add(self, path: KeyPath, message: str, *, of_key: bool = False) -> None:
        """Adds a problem of the value at `path`, or of the key itself."""
        self.found[self._at(path, message, of_key)] = None

    def settle(
        self, path: KeyPath, message: str, part: KeyPath = (), *, of_key: bool = False
    ) -> None:
        """Adds the one problem of `path`, at a part of it; what is there is not looked at again."""
        self.add((*path, *part), message, of_key=of_key)
        self.settled.append(path)

    def is_settled(self, path: KeyPath) -> bool:
        """Whether all that is to be said of `path` was said."""
        return any(path[: len(settled)] == settled for settled in self.settled)

    def doubt(self, path: KeyPath, message: str) -> None:
        """Adds what is allowed at `path` but can't be what was meant."""
        self.doubts.append(self._at(path, message, of_key=False))

    def _at(self, path: KeyPath, message: str, of_key: bool) -> Problem:
        place = self.document.place(path, of_key=of_key)
        key = self.document.spell(path)
        return Problem(self.document.file, place.line, place.column, key, message)

    def line(self, path: KeyPath) -> int:
        """The line of the key at `path`."""
        return self.document.place(path, of_key=True).line
