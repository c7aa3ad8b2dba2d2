"""An import in the source, and circles of imports."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path


@dataclass(frozen=True)
class Import:
    """An import of `name` by `importer`, at a line of its file.

    `target` is the module that defines the name: a file of the project, or a library.
    """

    importer: str
    file: Path
    line: int
    name: str
    target: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.importer} imports {self.name}"


def circles(imports: Iterable[Import]) -> list[list[Import]]:
    """Returns the shortest circle for each group of modules that import each other."""
    by_importer: dict[str, dict[str, Import]] = {}
    for one in imports:
        if one.target != one.importer:
            by_importer.setdefault(one.importer, {}).setdefault(one.target, one)
    found = []
    seen: set[str] = set()
    for module in sorted(by_importer):
        circle = None if module in seen else _way(by_importer, module, module)
        if circle:
            found.append(circle)
            seen |= _group(by_importer, module)
    return found


def _group(by_importer: dict[str, dict[str, Import]], module: str) -> set[str]:
    """Returns every module that `module` reaches and that reaches `module`."""
    reached = set(_reached(by_importer, module))
    return {one for one in reached if module in _reached(by_importer, one)}


def _reached(by_importer: dict[str, dict[str, Import]], start: str) -> Iterator[str]:
    waiting, seen = [start], set()
    while waiting:
        for target in by_importer.get(waiting.pop(), ()):
            if target not in seen:
                seen.add(target)
                waiting.append(target)
                yield target


def _way(by_importer: dict[str, dict[str, Import]], start: str, end: str) -> list[Import] | None:
    """Returns the shortest path of imports from one module to another."""
    ways: deque[list[Import]] = deque([[one] for one in by_importer[start].values()])
    seen = set()
    while ways:
        way = ways.popleft()
        last = way[-1].target
        if last == end:
            return way
        if last not in seen:
            seen.add(last)
            ways.extend([*way, one] for one in by_importer.get(last, {}).values())
    return None
