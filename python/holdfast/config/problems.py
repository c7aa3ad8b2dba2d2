"""What is wrong with a configuration: one `Problem` a mistake, all of them in one `ConfigError`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


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
