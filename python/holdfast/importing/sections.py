"""Reading a mapping key by key, so that every key is either asked for or told as left out.

A value of the wrong kind is a problem, and reads as if it were not there: so no mistake hides
another.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.config.words import choice, guess, show

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.config.source import KeyPath
    from holdfast.importing.notes import Desk

_TRUE = ("yes", "Yes", "YES", "on", "On", "ON")
_FALSE = ("no", "No", "NO", "off", "Off", "OFF")


@dataclass
class Section:
    """The mapping at `path`. An empty value is the same as none, as it was to the source."""

    desk: Desk
    path: KeyPath
    data: dict[Any, Any]
    _asked: set[Any] = field(default_factory=set, init=False)

    def at(self, *parts: str | int) -> KeyPath:
        """The path of a key in here."""
        return (*self.path, *parts)

    def get(self, key: str | int) -> Any:
        """The value as it is written, `None` when there is none."""
        self._asked.add(key)
        return self.data.get(key)

    def mapping(self, key: str | int, *, required: bool = False) -> Section | None:
        """The mapping of that key."""
        value = self._present(key, "a mapping", required)
        if isinstance(value, dict):
            return Section(self.desk, self.at(key), value)
        self._wrong(key, value, "a mapping")
        return None

    def entries(self, key: str, *, required: bool = False) -> list[tuple[KeyPath, Any]] | None:
        """The entries of the list of that key, each with its path."""
        value = self._present(key, "a list", required)
        if isinstance(value, list):
            return [(self.at(key, index), entry) for index, entry in enumerate(value)]
        self._wrong(key, value, "a list")
        return None

    def integer(
        self, key: str, least: int, most: int, *, required: bool = False, what: str = "an integer"
    ) -> int | None:
        """The integer of that key."""
        allowed = f"{what} from {least} to {most}"
        value = self._present(key, allowed, required)
        if type(value) is int and least <= value <= most:
            return value
        self._wrong(key, value, allowed)
        return None

    def flag(self, key: str) -> bool | None:
        """The boolean of that key; the source took `yes` and `on` for booleans too."""
        value = self.get(key)
        if isinstance(value, bool):
            return value
        if isinstance(value, str) and value in (*_TRUE, *_FALSE):
            return value in _TRUE
        self._wrong(key, value, "true or false")
        return None

    def text(self, key: str, *, required: bool = False) -> str | None:
        """The text of that key without spaces around it; `None` when it is empty."""
        value = self._present(key, "text", required)
        if isinstance(value, str):
            return value.strip() or None
        self._wrong(key, value, "text")
        return None

    def name(self, key: str, *, required: bool = False) -> str | None:
        """The text of that key, where a number is a name too."""
        value = self.get(key)
        return str(value) if type(value) is int else self.text(key, required=required)

    def secret(self, key: str) -> str | None:
        """The text of that key; no message shows it."""
        value = self.get(key)
        if value is None or isinstance(value, str):
            return value or None
        self.desk.problem(self.at(key), "found no text (not shown here), allowed: text in quotes")
        return None

    def word(self, key: str, allowed: Sequence[str], *, required: bool = False) -> str | None:
        """One of the words that the key can have."""
        value = self._present(key, choice(allowed), required)
        if isinstance(value, str) and value in allowed:
            return value
        self._wrong(key, value, choice(allowed))
        return None

    def close(self, reasons: Mapping[str, str] | None = None) -> None:
        """Notes every key that nobody asked for, with the reason where one is known."""
        known = [key for key in self._asked if isinstance(key, str)]
        for key in self.data:
            if key in self._asked:
                continue
            if key == "<<":
                message = "found a merge key, allowed: the keys themselves"
                self.desk.problem(self.at(key), message, of_key=True)
                continue
            message = (reasons or {}).get(key) or f"unknown key{guess(key, known)}"
            self.desk.note("left out", self.at(key), message)

    def _present(self, key: str | int, allowed: str, required: bool) -> Any:
        value = self.get(key)
        if value is None and required:
            self.desk.problem(self.at(key), f"missing, allowed: {allowed}", of_key=True)
        return value

    def _wrong(self, key: str | int, value: object, allowed: str) -> None:
        if value is not None:
            self.desk.problem(self.at(key), f"found {show(value)}, allowed: {allowed}")


def section(desk: Desk, path: KeyPath, value: object) -> Section | None:
    """The mapping at `path`; anything else is a problem."""
    if isinstance(value, dict):
        return Section(desk, path, value)
    desk.problem(path, f"found {show(value)}, allowed: a mapping")
    return None
