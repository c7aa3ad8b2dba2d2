"""Converts areas and seals of memories, which are similar in both generations."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from holdfast.protocol import ADDRESSES
from holdfast.runtime.text import extent, listing
from holdfast.types import AREAS

if TYPE_CHECKING:
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.key_reader import Section
    from holdfast.importing.notes import Desk


def read_id(name: str) -> dict[str, int]:
    """The id of a memory whose name is a number: Raw Ingest finds the memory by that number."""
    number = int(name) if re.fullmatch("0|[1-9][0-9]{0,4}", name) else ADDRESSES
    return {"id": number} if number < ADDRESSES else {}


def read_areas(memory: Section, size_key: str) -> dict[str, Any]:
    """The areas by name, as in a Holdfast configuration."""
    areas: dict[str, Any] = {}
    wrong = len(memory.desk.report.problems)
    for area in AREAS:
        if type(memory.get(area)) is int:
            extent = _extent(memory, area, 0, memory.integer(area, 0, ADDRESSES) or 0)
        else:
            extent = _long_form(memory, area, size_key)
        if extent is not None:
            areas[area] = extent
    if not areas and len(memory.desk.report.problems) == wrong:
        message = f"no area, allowed: at least one of {listing(AREAS)}"
        memory.desk.problem_of_key(memory.path, message)
    return areas


def _long_form(memory: Section, area: str, size_key: str) -> dict[str, int] | int | None:
    section = memory.mapping(area)
    if section is None:
        return None
    start = section.integer("start", 0, ADDRESSES - 1)
    size = section.integer(size_key, 0, ADDRESSES, required=True)
    section.close()
    return None if size is None else _extent(memory, area, start or 0, size)


def _extent(memory: Section, area: str, start: int, size: int) -> dict[str, int] | int | None:
    if size == 0:
        memory.left_out(area, "the area has no addresses")
        return None
    if start + size > ADDRESSES:
        message = f"found start {start} and size {size}, allowed: a sum up to {ADDRESSES}"
        memory.problem(area, message)
        return None
    return {"start": start, "size": size} if start else size


def addresses(extent: Any) -> range:
    """The addresses of an area that `read_areas` returned."""
    if isinstance(extent, int):
        return range(extent)
    return range(extent["start"], extent["start"] + extent["size"])


def check_gate(
    desk: Desk, path: KeyPath, memory: str, areas: dict[str, Any], area: str, address: int
) -> bool:
    """Whether the gate bit is inside its area; adds a problem if not."""
    if area not in areas:
        message = f"the gate is in {area}, which {memory} does not have"
        desk.problem(path, f"{message}, allowed: a memory with that area, or no seal")
        return False
    there = addresses(areas[area])
    if address in there:
        return True
    desk.problem(path, f"found {address}, allowed in {area} of {memory}: {extent(there)}")
    return False
