"""The result of an import, and the reading of its source file."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from holdfast.config.dump import to_yaml
from holdfast.config.text import yaml_document
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError
from holdfast.importing.notes import Desk, Note

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config.text.problems import Problem
    from holdfast.config.text.yaml_document import KeyPath, Resolve

Generation: TypeAlias = Literal[1, 2]
ORDINALS: dict[Generation, str] = {1: "first", 2: "second"}

_OCTAL = re.compile(r"0[0-7]+(?![0-9A-Za-z_.:-])", re.ASCII)
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

        `resolve` gives tags of the source a value; such a source also accepted merge keys, and
        took the last of equal keys.
        """
        self.file = str(path)
        text = yaml_document.read_text(Path(path), self.file)
        try:
            merges = resolve is not None
            document, found = yaml_document.parse(text, self.file, resolve, merges=merges)
        except ConfigError as error:
            raise ConfigError(self.file, _without_secrets(text, error.problems)) from None
        self.problems = _without_secrets(text, found)
        self.desk = Desk(document)
        self._lines = text.splitlines()
        self._look_at((), document.data)

    def narrow(self, paths: Sequence[KeyPath]) -> None:
        """Reads nothing but the values at these paths: problems elsewhere do not matter."""
        keys = [self.desk.document.spell(path) for path in paths]
        self.problems = [
            each for each in self.problems if any(_is_in(key, each.key) for key in keys)
        ]
        self.desk.report.found.clear()
        self.desk.noted.clear()
        for path in paths:
            self._look_at(path, self.desk.report.raw(path))

    def _look_at(self, path: KeyPath, value: object) -> None:
        self.desk.broken = {each.key for each in self.problems}
        self._refuse_octal(self._lines, path, value)
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

    def _refuse_octal(self, lines: Sequence[str], path: KeyPath, value: object) -> None:
        """Adds a problem for each integer that is octal for the source, but not here."""
        if isinstance(value, dict | list):
            inside = value.items() if isinstance(value, dict) else enumerate(value)
            for key, each in inside:
                self._refuse_octal(lines, (*path, key), each)
        elif type(value) is int:
            place = self.desk.document.place(path)
            written = _OCTAL.match(" ".join(lines[place.line - 1 : place.line]), place.column - 1)
            if written is not None and (octal := int(written[0], 8)) != value:
                message = f"found {written[0]}, which the source read as octal, allowed: {octal}"
                self.desk.problem(path, f"{message}, or {value} if that is meant")

    def finish(self) -> None:
        """Raises `NotImportable` if there was any problem."""
        problems = self.problems + self.desk.report.problems
        if problems:
            raise NotImportable(self.file, problems, self.desk.notes)


def _is_in(section: str, key: str) -> bool:
    """Whether the key of a problem is that of a section, or one inside it."""
    return key == section or key.startswith((f"{section}.", f"{section}["))


def _without_secrets(text: str, problems: Iterable[Problem]) -> list[Problem]:
    """Hides what a YAML error quotes from a line that may contain a secret."""
    lines = text.splitlines()
    hidden = "not YAML (line hidden, as it may contain a secret), allowed: text in quotes"
    return [
        replace(problem, message=hidden)
        if problem.line and _SECRET.search(" ".join(lines[problem.line - 1 : problem.line]))
        else problem
        for problem in problems
    ]
