"""Errors of a configuration: one `Problem` per error, all of them in one `ConfigError`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.runtime.bounded_files import NotAnswered


@dataclass(frozen=True, slots=True)
class Problem:
    """One error. `line` and `column` count from 1; they are `None` for a whole file.

    `key` is the path of the key, as in `listeners.scada.rules[0].access`; "" at the top level.
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
    """The configuration is not valid. `problems` has every error: first those of the file itself,
    by line, then those of the files that it names.
    """

    def __init__(self, file: str, problems: Iterable[Problem]) -> None:
        def order(problem: Problem) -> tuple[bool, str, int, int]:
            other = problem.file != file
            return (other, problem.file, problem.line or 0, problem.column or 0)

        self.problems: tuple[Problem, ...] = tuple(sorted(problems, key=order))
        super().__init__(file, self.problems)  # Its arguments, so that it can be pickled.

    def __str__(self) -> str:
        return "\n".join(str(problem) for problem in self.problems)


class ConfigNotAnswered(ConfigError):
    """A file was not read in time, or for now. The configuration may be valid."""

    @classmethod
    def of(cls, error: NotAnswered) -> ConfigNotAnswered:
        """That of an error of the system."""
        file = str(error.filename)
        return cls(file, [Problem(file, None, None, "", f"can't be read: {error.strerror}")])
