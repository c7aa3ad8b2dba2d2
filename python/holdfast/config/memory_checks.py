"""Checks rules between keys of memories: areas, seals, ids and initial values."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from pydantic import TypeAdapter

from holdfast import bounded_files
from holdfast.config import initial
from holdfast.config.lenient import fitting, integer, mapping
from holdfast.config.memories import Extent, Span
from holdfast.config.problems import ConfigError
from holdfast.config.unique import Owners
from holdfast.config.words import show
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_WORD
from holdfast.runtime.text import listing
from holdfast.types import AREAS, BIT_AREAS, Area

if TYPE_CHECKING:
    from holdfast.config.problems import Problem
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

_EXTENT: TypeAdapter[Span | None] = TypeAdapter(Extent)

Layout: TypeAlias = dict[Area, range | None]
"""The addresses of the existing areas; `None` if an error makes them unknown."""


def addresses(extent: object) -> range | None:
    """The addresses of an area from the data of the file; `None` if they are not valid."""
    span = fitting(_EXTENT, extent)
    return None if span is None or span.start + span.size > ADDRESSES else span.addresses


def area_of(
    memories: dict[Any, Any], path: KeyPath, name: object, area: Any, report: Report
) -> range | None:
    """The addresses of an area of a memory, `None` if the memory or area is not valid.

    Reports an area that the memory does not have, at the key `area` of `path`.
    """
    memory = memories.get(name) if isinstance(name, str) else None
    if not isinstance(memory, dict):
        return None
    if area not in memory:
        areas = [each for each in AREAS if each in memory]
        allowed = f"allowed: {listing(areas)}" if areas else "and it has no other area"
        message = f"found {show(area)}, an area that {name} does not have, {allowed}"
        report.add((*path, "area"), message)
        return None
    return addresses(memory[area])


@dataclass
class MemoryChecks:
    """Checks the memories of one file, and reads the files with their initial values."""

    folder: Path
    report: Report

    def __post_init__(self) -> None:
        self.values: dict[Path, tuple[initial.InitialRun, ...]] = {}
        self.problems_elsewhere: list[Problem] = []

    def check(self, memories: object) -> None:
        """Reports problems. Afterwards `values` has the initial values by file."""
        for name, memory in mapping(memories).items():
            if isinstance(memory, dict):
                self._memory(("memories", name), memory)
        self._ids(mapping(memories))
        self._files(mapping(memories))

    def _memory(self, path: KeyPath, memory: dict[Any, Any]) -> None:
        layout: Layout = {
            area: self._addresses((*path, area), memory[area]) for area in AREAS if area in memory
        }
        if not layout:
            message = f"no area, allowed: at least one of {listing(AREAS)}"
            self.report.add(path, message, of_key=True)
        gate = self._gate((*path, "seal"), mapping(memory.get("seal")), layout)
        if isinstance(memory.get("initial"), str) and memory["initial"]:
            self._initial((*path, "initial"), memory["initial"], layout, gate)

    def _addresses(self, path: KeyPath, extent: object) -> range | None:
        span = fitting(_EXTENT, extent)
        if span is None:
            return None
        if span.start + span.size <= ADDRESSES:
            return span.addresses
        message = f"found start {span.start} and size {span.size}, allowed: a sum up to {ADDRESSES}"
        self.report.add(path, message)
        return None

    def _gate(self, path: KeyPath, seal: dict[Any, Any], layout: Layout) -> initial.Cell | None:
        area, address = seal.get("area"), integer(seal.get("address"), 0, LAST_ADDRESS)
        if area not in BIT_AREAS:
            return None
        if area not in layout:
            there = [area for area in BIT_AREAS if area in layout]
            allowed = f"allowed: {listing(there)}" if there else "and it has no area of bits"
            message = f"found {show(area)}, an area that this memory does not have, {allowed}"
            self.report.add((*path, "area"), message)
            return None
        addresses = layout[area]
        if address is None or addresses is None:
            return None
        if address not in addresses:
            message = f"found {address}, allowed in {area}: {initial.extent(addresses)}"
            self.report.add((*path, "address"), message)
            return None
        return area, address

    def _initial(self, path: KeyPath, file: str, layout: Layout, gate: initial.Cell | None) -> None:
        if Path(file).suffix.lower() not in initial.KINDS:
            allowed = listing(initial.KINDS)
            self.report.add(path, f"found {show(file)}, allowed: a file with one of {allowed}")
            return
        shown = str(Path(self.report.document.file).parent / file)
        try:
            text = initial.read(self.folder / file, shown)
        except ConfigError as error:
            self.report.add(path, f"found {show(file)}, which {error.problems[0].message}")
            return
        runs, problems = initial.parse(text, shown, layout, gate)
        self.values[self.folder / file] = runs
        self.problems_elsewhere += problems

    def _files(self, memories: dict[Any, Any]) -> None:
        """Memories in one file are written together, so they have the same sync."""
        first: dict[str, tuple[str, object]] = {}
        for name, memory in memories.items():
            keep = mapping(mapping(memory).get("keep"))
            file, sync = keep.get("file"), keep.get("sync", 1)
            if not isinstance(file, str) or not file:
                continue
            path: KeyPath = ("memories", name, "keep")
            found = str(self.folder / file)
            if not bounded_files.call(found, Path(found).parent.is_dir):
                self.report.add((*path, "file"), f"found {show(file)}, whose folder does not exist")
            elif bounded_files.call(found, Path(found).is_dir):
                self.report.add((*path, "file"), f"found {show(file)}, which is a folder")
            elif found in first and first[found][1] != sync:
                other = first[found][0]
                allowed = f"{show(first[found][1])}, as {other} has for the file"
                message = f"found {show(sync)}, allowed: {allowed}"
                self.report.add((*path, "sync"), message)
            first.setdefault(found, (str(name), sync))

    def _ids(self, memories: dict[Any, Any]) -> None:
        owners = Owners(self.report, "id")
        for name, memory in memories.items():
            path: KeyPath = ("memories", name)
            number = integer(mapping(memory).get("id"), 0, MAX_WORD)
            if number is not None:
                owners.claim((*path, "id"), number, str(number), path)
