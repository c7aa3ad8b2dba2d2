"""Compares the imports of a tree with the table of rooms in a page such as docs/architecture.md.

A room is a package, a crate, or a part of one. The table has a row for each room, with the rooms
and the libraries that it may import. If the table lists parts of a crate or package, the row of the
whole applies only to its top file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from support.imports import Import, circles

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

HEADINGS = ["room", "may import of ours", "may import of others"]


@dataclass(frozen=True)
class Row:
    """The allowed imports of one room."""

    rooms: tuple[str, ...]
    libraries: tuple[str, ...]

    def __str__(self) -> str:
        return ", ".join([*self.rooms, *self.libraries]) or "nothing"


class Architecture:
    """The table of a page."""

    def __init__(self, page: Path) -> None:
        self.page = page
        self.rows = _rows(page)

    def room(self, module: str) -> str | None:
        """Returns the room of a module."""
        if module in self.rows:
            return module
        above = [room for room in self.rows if _is_in(module, room)]
        parents = [room for room in above if not any(_is_in(row, room) for row in self.rows)]
        return parents[0] if parents else None

    def modules_without_a_room(self, modules: Mapping[str, Path]) -> list[str]:
        """Returns the files without a row."""
        return [
            f"{file}: {self.page.name} has no row for {module}"
            for module, file in modules.items()
            if self.room(module) is None
        ]

    def rooms_without_a_module(self, modules: Iterable[str]) -> list[str]:
        """Returns the rows without a file."""
        found = {self.room(module) for module in modules}
        return [room for room in self.rows if room not in found]

    def forbidden(self, imports: Iterable[Import], modules: Iterable[str]) -> list[str]:
        """Returns the imports that the table does not allow, each with what it allows."""
        ours = set(modules)
        return [
            f"{one}; {self.page.name} allows {room} to import: {self.rows[room]}"
            for one in imports
            if (room := self.room(one.importer)) is not None and not self._allows(room, one, ours)
        ]

    def unused(self, imports: Iterable[Import], modules: Iterable[str]) -> list[str]:
        """Returns allowed imports that no file uses."""
        ours = set(modules)
        used: set[tuple[str | None, str | None]] = set()
        for one in imports:
            room = self.room(one.importer)
            other = self.room(one.target)
            libraries = self.rows[room].libraries if room is not None else ()
            used |= {(room, library) for library in libraries if _is_or_is_in(one.name, library)}
            if one.target in ours:
                used.add((room, other))
        return [
            f"{room} imports nothing of {name}, though {self.page.name} allows it"
            for room, row in self.rows.items()
            for name in (*row.rooms, *row.libraries)
            if (room, name) not in used
        ]

    def circles_of_rooms(self, imports: Iterable[Import]) -> list[list[Import]]:
        """Returns circles of rooms that import each other."""
        return circles(
            replace(one, importer=importer, target=target)
            for one in imports
            if (importer := self.room(one.importer)) and (target := self.room(one.target))
        )

    def _allows(self, room: str, one: Import, ours: set[str]) -> bool:
        if one.target in ours:
            other = self.room(one.target)
            return other == room or other in self.rows[room].rooms
        return any(_is_or_is_in(one.name, library) for library in self.rows[room].libraries)


def shown(circle: list[Import]) -> str:
    """Formats the imports of a circle, in order."""
    return "\n  ".join(["a circle of imports:", *map(str, circle)])


def _is_in(module: str, room: str) -> bool:
    return module.startswith((f"{room}.", f"{room}::"))


def _is_or_is_in(name: str, room: str) -> bool:
    return name == room or _is_in(name, room)


def _rows(page: Path) -> dict[str, Row]:
    rows: dict[str, Row] = {}
    lines = iter(page.read_text(encoding="utf-8").splitlines())
    if not any(_cells(line) == HEADINGS for line in lines):
        raise ValueError(f"{page}: no table has the columns {' | '.join(HEADINGS)}")
    next(lines)
    for line in lines:
        if not line.startswith("|"):
            break
        room, rooms, libraries = (re.findall(r"`([^`]+)`", cell) for cell in _cells(line))
        if len(room) != 1 or room[0] in rows:
            raise ValueError(f"{page}: one row for each room is required, found {line}")
        rows[room[0]] = Row(tuple(rooms), tuple(libraries))
    for name, row in rows.items():
        if unknown := [room for room in row.rooms if room not in rows]:
            raise ValueError(f"{page}: {name} may import {unknown}, which are not rooms")
    return rows


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]
