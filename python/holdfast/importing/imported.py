"""The result of an import, and the reading of its source file."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from holdfast.config.dump import to_yaml
from holdfast.config.text import yaml_document
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError, ConfigNotAnswered, Problem
from holdfast.importing.notes import Desk, Note

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config.text.yaml_document import KeyPath, Resolve

Generation: TypeAlias = Literal[1, 2]
ORDINALS: dict[Generation, str] = {1: "first", 2: "second"}

_BREAK = re.compile(r"\r\n|\r|\n")
"""What ends a line of YAML; `splitlines` also takes U+2028, of which YAML counts none."""

_OTHER_BASE = re.compile(
    r"(?:[&!]\S*[ \t]+)*([-+]?0(?:b_*[01][01_]*|[0-7_]+))(?![0-9A-Za-z_.:-])", re.ASCII
)
"""An octal or binary number of YAML 1.1, behind its anchor and tag, where the place of a value
is."""

_SECRET = re.compile(r"(token|password|broker)[\"']?\s*:")


@dataclass(frozen=True)
class Imported:
    """A Holdfast configuration, with notes on the conversion."""

    file: str
    command: str
    """The command that imports it."""
    program: str
    """The program that it is for."""
    data: dict[str, Any]
    notes: tuple[Note, ...]
    generation: Generation | None = None
    """The generation of its format, if there are several."""

    def to_yaml(self) -> str:
        """The configuration as YAML, with the notes as comments above it."""
        of = f"{ORDINALS[self.generation]} generation: " if self.generation else ""
        made = f"Made by `holdfast import {self.command}` from a configuration of {self.program},"
        lines = [made, f"{of}{self.file}"]
        if self.notes:
            lines += ["Left out, changed or to be checked:", *map(str, self.notes)]
        comments = "".join(f"# {' '.join(line.splitlines())}\n" for line in lines)
        return f"{comments}\n{to_yaml(self.data)}"


class NotImportable(ConfigError):
    """The source can't be imported; `notes` has the notes until then."""

    def __init__(self, file: str, problems: Iterable[Problem], notes: tuple[Note, ...]) -> None:
        super().__init__(file, problems)
        self.args = (file, self.problems, notes)
        self.notes = notes


class Source:
    """A source file while it is read: its `desk` has its data, and takes notes and problems."""

    def __init__(self, path: Path | str, resolve: Resolve | None = None) -> None:
        """Raises `ConfigError` for a file that can't be read.

        `resolve` gives tags of the source a value; such a source also accepted merge keys and
        numbers with underscores, and took the last of equal keys.
        """
        self.file = str(path)
        text = yaml_document.read_text(Path(path), self.file)
        self._lines = {self.file: _BREAK.split(text)}
        """The lines of each file."""
        self._has_underscores = resolve is not None

        def known(kind: str, text: str, file: str) -> Any:
            assert resolve is not None, "only with it are tags given a value"
            found = resolve(kind, text, file)
            if isinstance(found, yaml_document.Included):
                self._lines[found.file] = _BREAK.split(found.text)
            return found

        try:
            merges = resolve is not None
            document, found = yaml_document.parse(
                text, self.file, known if merges else None, merges=merges
            )
        except ConfigNotAnswered:
            raise
        except ConfigError as error:
            raise ConfigError(self.file, self._without_secrets(error.problems)) from None
        self.problems = self._without_secrets(found)
        self.desk = Desk(document)
        self._look_at((), document.data)

    def narrow(self, paths: Sequence[KeyPath]) -> list[tuple[KeyPath, Problem]]:
        """Reads nothing but the values at these paths. Returns the problems elsewhere, with the
        paths to which merge keys bring them.
        """
        inside: list[Problem] = []
        elsewhere: list[tuple[KeyPath, Problem]] = []
        for written, problem in zip(self.desk.document.mistaken, self.problems, strict=True):
            path = _without_merges(written)
            if any(path[: len(each)] == each for each in paths):
                inside.append(problem)
            else:
                elsewhere.append((path, problem))
        self.problems = inside
        self.desk.report.found.clear()
        self.desk.noted.clear()
        for path in paths:
            self._look_at(path, self.desk.report.raw(path))
        return elsewhere

    def _look_at(self, path: KeyPath, value: object) -> None:
        self._refuse_other_bases(path, value)
        self.desk.broken = {each.key for each in self.problems + self.desk.report.problems}
        for repeated, line in self.desk.document.repeated:
            if all(one == other for one, other in zip(path, repeated, strict=False)):
                message = f"line {line} has it, too: the last counts, as in the source"
                self.desk.check(repeated, message)

    def is_mapping(self) -> bool:
        """Whether the file contains a mapping; adds a problem otherwise."""
        data = self.desk.document.data
        if not isinstance(data, dict):
            found = "an empty file" if data is None else show(data)
            self.desk.problem((), f"found {found}, allowed: a mapping")
        return isinstance(data, dict)

    def _refuse_other_bases(self, path: KeyPath, value: object) -> None:
        """Adds a problem for each integer that is octal or binary for the source, but not here."""
        if isinstance(value, dict | list):
            inside = value.items() if isinstance(value, dict) else enumerate(value)
            for key, each in inside:
                self._refuse_other_bases((*path, key), each)
        elif type(value) is int or (self._has_underscores and isinstance(value, str)):
            place = self.desk.document.place(path)
            line = self._line(place.file, place.line)
            found = _OTHER_BASE.match(line, place.column - 1)
            if found is None:
                return
            # With underscores, it is text here, and numbers are also read from text.
            if isinstance(value, str) and (value != found[1] or self.desk.document.is_text(path)):
                return
            digits = found[1].replace("_", "")
            base, name = (2, "binary") if "b" in digits else (8, "octal")
            if (number := int(digits, base)) == value:
                return
            meant = f", or {value} if that is meant" if type(value) is int else ""
            shown, allowed = found[1], f"{number}{meant}"
            if _SECRET.search(line):
                shown, allowed = "a number (hidden, as it may be a secret)", "text in quotes"
            message = f"found {shown}, which the source read as {name}, allowed: {allowed}"
            self.desk.problem(path, message)

    def _without_secrets(self, problems: Iterable[Problem]) -> list[Problem]:
        """Hides what a YAML error quotes from a line that may contain a secret."""
        hidden = "not YAML (line hidden, as it may contain a secret), allowed: text in quotes"
        return [
            replace(problem, message=hidden)
            if problem.line and _SECRET.search(self._line(problem.file, problem.line))
            else problem
            for problem in problems
        ]

    def _line(self, file: str, line: int) -> str:
        return " ".join(self._lines[file][line - 1 : line])

    def finish(self) -> None:
        """Raises `NotImportable` if there was any problem."""
        problems = self.problems + self.desk.report.problems
        if problems:
            raise NotImportable(self.file, problems, self.desk.notes)


def _without_merges(path: KeyPath) -> KeyPath:
    """The path at which a value is when the merge keys above it have added it."""
    return tuple(
        key
        for above, key in zip(("", *path), path, strict=False)
        if key != "<<" and not (above == "<<" and isinstance(key, int))
    )
