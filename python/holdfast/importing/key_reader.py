"""Reads a mapping key by key, so that every unread key gets a note.

A value of the wrong type is a problem and counts as absent, so no error hides another.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from math import isfinite
from typing import TYPE_CHECKING, Any

from holdfast.config.text.messages import show
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import either

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk

_TRUE = ("yes", "Yes", "YES", "on", "On", "ON")
_FALSE = ("no", "No", "NO", "off", "Off", "OFF")


class Secret(str):
    """A text that no message shows: `show` has it as `a secret`."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "a secret"


@dataclass
class Section:
    """The mapping at `path`. An empty value counts as absent, as in the source."""

    desk: Desk
    path: KeyPath
    data: dict[Any, Any]
    _asked: set[Any] = field(default_factory=set, init=False)

    def at(self, *parts: str | int) -> KeyPath:
        """The path of a key in this mapping."""
        return (*self.path, *parts)

    def get(self, key: str | int) -> Any:
        """The value as in the file, `None` if it is absent."""
        self._asked.add(key)
        return self.data.get(key)

    def mapping(self, key: str | int, *, required: bool = False) -> Section | None:
        """The mapping at a key."""
        value = self._present(key, "a mapping", required)
        if isinstance(value, dict):
            return Section(self.desk, self.at(key), value)
        self._wrong(key, value, "a mapping")
        return None

    def entries(self, key: str, *, required: bool = False) -> list[tuple[KeyPath, Any]] | None:
        """The entries of the list at a key, each with its path."""
        value = self._present(key, "a list", required)
        if isinstance(value, list):
            return [(self.at(key, index), entry) for index, entry in enumerate(value)]
        self._wrong(key, value, "a list")
        return None

    def sections(self, key: str, *, required: bool = False) -> list[Section]:
        """The mappings in the list at a key; adds a problem for any other entry."""
        entries = self.entries(key, required=required) or []
        found = [section(self.desk, path, value) for path, value in entries]
        return [each for each in found if each is not None]

    def integer(
        self, key: str, least: int, most: int, *, required: bool = False, what: str = "an integer"
    ) -> int | None:
        """The integer at a key."""
        allowed = f"{what} from {least} to {most}"
        value = self._present(key, allowed, required)
        number = self.as_number(value)
        if type(number) is int and least <= number <= most:
            return number
        self._wrong(key, value, allowed)
        return None

    def number(self, key: str) -> int | float | None:
        """The number at a key."""
        value = self.get(key)
        number = self.as_number(value)
        if isinstance(number, int | float) and not isinstance(number, bool) and isfinite(number):
            return number
        self._wrong(key, value, "a number")
        return None

    def as_number(self, value: object) -> object:
        """The number that a text contains, if the source accepted that; else the value."""
        if isinstance(value, str) and self.desk.quoted_numbers:
            for kind in (int, float):
                with suppress(ValueError):
                    return kind(value)
        return value

    def flag(self, key: str) -> bool | None:
        """The boolean at a key; the source also accepted `yes` and `on`."""
        value = self.get(key)
        if isinstance(value, bool):
            return value
        if isinstance(value, str) and value in (*_TRUE, *_FALSE):
            return value in _TRUE
        self._wrong(key, value, "true or false")
        return None

    def text(self, key: str, *, required: bool = False) -> str | None:
        """The text at a key, stripped; `None` if it is empty."""
        value = self._present(key, "text", required)
        if isinstance(value, str):
            text = value.strip()
            if required and not text:
                self.problem(key, "found an empty text, allowed: text")
            return text or None
        self._wrong(key, value, "text")
        return None

    def name(self, key: str, *, required: bool = False) -> str | None:
        """The name at a key, which can be a number."""
        value = self.get(key)
        return str(value) if type(value) is int else self.text(key, required=required)

    def secret(self, key: str) -> str | None:
        """The text at a key, which no message shows."""
        value = self.get(key)
        if value is None or isinstance(value, str):
            return value or None
        self.problem(key, "not text (value hidden), allowed: text in quotes")
        return None

    def word(
        self, key: str, allowed: Sequence[str], *, required: bool = False, any_case: bool = False
    ) -> str | None:
        """The word at a key, one of those allowed."""
        value = self._present(key, either(allowed), required)
        word = value.strip().lower() if any_case and isinstance(value, str) else value
        if isinstance(word, str) and word in allowed:
            return word
        self._wrong(key, value, either(allowed))
        return None

    def problem(self, key: str | int, message: str) -> None:
        """Adds a problem with the value at a key."""
        self.desk.problem(self.at(key), message)

    def problem_of_key(self, key: str | int, message: str) -> None:
        """Adds a problem with a key itself, such as a missing one."""
        self.desk.problem_of_key(self.at(key), message)

    def left_out(self, key: str | int, message: str) -> None:
        """Notes that the result does not have what is at a key."""
        self.desk.left_out(self.at(key), message)

    def changed(self, key: str | int, message: str) -> None:
        """Notes that what is at a key is converted differently."""
        self.desk.changed(self.at(key), message)

    def check(self, key: str | int, message: str) -> None:
        """Notes that a person must check what is at a key."""
        self.desk.check(self.at(key), message)

    def leave_out_all(self, message: str) -> None:
        """Notes that the result does not have what this mapping describes, with all its keys."""
        self.desk.left_out(self.path, message)
        self._asked.update(self.data)

    def close(self, reasons: Mapping[str, str] | None = None) -> None:
        """Adds a note for every unread key, with the reason if it is known."""
        if self._has_problem():  # Keys may be unread because of it.
            return
        known = [key for key in self._asked if isinstance(key, str)]
        for key in self.data:
            if key in self._asked:
                continue
            message = (reasons or {}).get(key) or f"unknown key{suggestion(key, known)}"
            self.left_out(key, message)

    def _has_problem(self) -> bool:
        """Whether a key of this mapping has a problem itself."""
        depth = len(self.path)
        paths = self.desk.report.found.values()
        return any(path[:depth] == self.path and len(path) <= depth + 1 for path in paths)

    def _present(self, key: str | int, allowed: str, required: bool) -> Any:
        value = self.get(key)
        if self._is_broken(key):
            return None
        if value is None and required:
            self.problem_of_key(key, f"missing, allowed: {allowed}")
        return value

    def _wrong(self, key: str | int, value: object, allowed: str) -> None:
        if value is not None and not self._is_broken(key):
            self.problem(key, f"found {show(value)}, allowed: {allowed}")

    def _is_broken(self, key: str | int) -> bool:
        return self.desk.document.spell(self.at(key)) in self.desk.broken


def section(desk: Desk, path: KeyPath, value: object) -> Section | None:
    """The mapping at `path`; adds a problem for any other value that could be read."""
    if isinstance(value, dict):
        return Section(desk, path, value)
    if desk.document.spell(path) not in desk.broken:
        desk.problem(path, f"found {show(value)}, allowed: a mapping")
    return None


def seconds(milliseconds: int) -> float:
    """A time of the source, as configurations have it: an integer if it is whole."""
    return milliseconds / 1000 if milliseconds % 1000 else milliseconds // 1000
