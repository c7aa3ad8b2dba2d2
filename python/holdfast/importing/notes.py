"""The results of an import that people must read: notes, and problems.

Messages show found values, but never a secret.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias

from holdfast.config.report import Report

if TYPE_CHECKING:
    from holdfast.config.source import Document, KeyPath

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

    def __post_init__(self) -> None:
        self.report = Report(self.document)

    @property
    def notes(self) -> tuple[Note, ...]:
        """The notes in the order of the file, each once."""
        return tuple(sorted(self.noted, key=lambda note: (note.line, note.column)))

    def note(self, kind: Kind, path: KeyPath, message: str) -> None:
        """Adds a note about the key at `path`."""
        place = self.document.place(path, of_key=True)
        key = self.document.spell(path)
        self.noted[Note(kind, self.document.file, place.line, place.column, key, message)] = None

    def withdraw(self, path: KeyPath) -> None:
        """Removes the notes about the key at `path`: it has no effect."""
        key = self.document.spell(path)
        self.noted = {note: None for note in self.noted if note.key != key}

    def problem(self, path: KeyPath, message: str, *, of_key: bool = False) -> None:
        """Adds a problem, which makes the import impossible."""
        self.report.add(path, message, of_key=of_key)
