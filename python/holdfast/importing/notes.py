"""What people read of an import, notes and problems, and what its caller chooses.

Messages show found values, but never a secret.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

from holdfast.config.text.report import Report

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.text.problems import Problem
    from holdfast.config.text.yaml_document import Document, KeyPath
    from holdfast.types import Area


Kind: TypeAlias = Literal["left out", "changed", "check"]
"""`left out`: not in the result; `changed`: converted differently; `check`: a person must check."""


@dataclass(frozen=True, slots=True)
class Note:
    """What the import did with one place of the source; places are as in a `Problem`."""

    kind: Kind
    file: str
    line: int
    column: int
    key: str
    message: str

    def __str__(self) -> str:
        parts = (f"{self.file}:{self.line}", self.key, self.kind, self.message)
        return ": ".join(part for part in parts if part)


@dataclass
class Desk:
    """Collects the notes and the problems of one source file."""

    document: Document
    noted: dict[Note, None] = field(default_factory=dict)
    quoted_numbers: bool = False
    """Whether the source accepted numbers in quotes."""
    folds: bool = False
    """Whether equal notes on keys of the same name become one, with their number."""
    broken: set[str] = field(default_factory=set)
    """The keys whose values could not be read, which is a problem of its own."""

    def __post_init__(self) -> None:
        self.report = Report(self.document)

    @property
    def notes(self) -> tuple[Note, ...]:
        """The notes in the order of the file, then those of files inside it, each once."""

        def order(note: Note) -> tuple[bool, str, int, int]:
            return (note.file != self.document.file, note.file, note.line, note.column)

        notes = sorted(self.noted, key=order)
        if not self.folds:
            return tuple(notes)
        alike: dict[tuple[str, str, str], list[Note]] = {}
        for note in notes:
            last = re.sub(r"\[\d+\]", "", note.key.rpartition(".")[2])
            alike.setdefault((note.kind, last, note.message), []).append(note)
        return tuple(
            replace(first, message=f"{first.message} (and {len(more)} more)") if more else first
            for first, *more in alike.values()
        )

    def note(self, kind: Kind, path: KeyPath, message: str) -> None:
        """Adds a note about the key at `path`."""
        place = self.document.place(path, of_key=True)
        key = self.document.spell(path)
        self.noted[Note(kind, place.file, place.line, place.column, key, message)] = None

    def left_out(self, path: KeyPath, message: str) -> None:
        """Notes that the result does not have the key at `path`."""
        self.note("left out", path, message)

    def left_out_for(self, problem: Problem) -> None:
        """Notes that the result does not have what has this problem, which does not matter."""
        assert problem.line is not None, "a problem inside a file has a line"
        assert problem.column is not None, "and a column"
        place = (problem.file, problem.line, problem.column)
        self.noted[Note("left out", *place, problem.key, problem.message)] = None

    def changed(self, path: KeyPath, message: str) -> None:
        """Notes that the key at `path` is converted differently."""
        self.note("changed", path, message)

    def check(self, path: KeyPath, message: str) -> None:
        """Notes that a person must check the key at `path`."""
        self.note("check", path, message)

    def withdraw(self, path: KeyPath) -> None:
        """Removes the notes about the key at `path`: it has no effect."""
        key = self.document.spell(path)
        self.noted = {note: None for note in self.noted if note.key != key}

    def problem(self, path: KeyPath, message: str, *, of_key: bool = False) -> None:
        """Adds a problem, which makes the import impossible."""
        self.report.add(path, message, of_key=of_key)

    def problem_of_key(self, path: KeyPath, message: str) -> None:
        """Adds a problem with the key at `path` itself, such as a missing one."""
        self.problem(path, message, of_key=True)


@dataclass(frozen=True)
class Choices:
    """How keys that the source ignored are converted, and what is granted beyond what it did."""

    as_meant: bool = False
    keep_published_tokens: bool = False
    grant_rest: Sequence[Area] = ()
    """Areas that REST may write, in addition to those that it could."""
    grant_mqtt: Sequence[Area] = ()
    """The same for MQTT."""

    def note(self, desk: Desk, path: KeyPath, *, ran: str, meant: str) -> None:
        """Adds a note about a key with two meanings, which says the one that is used."""
        used, other = ("it was meant", "it ran") if self.as_meant else ("it ran", "it was meant")
        effect, otherwise = (meant, ran) if self.as_meant else (ran, meant)
        message = f"as {used}: {effect}; as {other}: {otherwise} (--as-{other.replace(' ', '-')})"
        desk.note("changed" if self.as_meant else "left out", path, message)
