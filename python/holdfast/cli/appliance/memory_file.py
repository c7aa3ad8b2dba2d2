"""Files of memories: reads and changes those that keep them, while no appliance uses them, and
writes those of `initial`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import click

from holdfast import _core
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import require_known
from holdfast.config.initial_values import KINDS, runs_of
from holdfast.runtime import whole_files
from holdfast.runtime.text import listing
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from holdfast.config.initial_values import InitialRun
    from holdfast.types import Area


FILE = "file:"
"""Prefix of a file number, in place of an area."""


class KeptArea(NamedTuple):
    """The values of an area, from its first address on."""

    start: int
    values: list[int]

    @property
    def addresses(self) -> range:
        """The addresses."""
        return range(self.start, self.start + len(self.values))

    def cells(self, *, zeros: bool) -> Iterator[tuple[int, int]]:
        """Addresses and values; those with the value 0 only with `zeros`."""
        return ((at, value) for at, value in enumerate(self.values, self.start) if value or zeros)


def contents(file: Path, *, set_aside: bool = False) -> dict[str, dict[Area, KeptArea]]:
    """The areas of each memory in a file, after a check of the whole file. Raises `OSError`.

    With `set_aside`, the values that were cut because the configured areas had changed.
    """
    found = _core.read_memory_file(str(file), set_aside=set_aside)
    return {
        name: {
            area: KeptArea(start, _values(area, size, data))
            for area, (start, size, data) in areas.items()
        }
        for name, areas in found.items()
    }


def chosen(memories: Collection[str], name: str | None, owner: object) -> str:
    """The memory of that name, or the only one. Raises `click.UsageError`."""
    if name is None and len(memories) > 1:
        raise click.UsageError(f"{owner} has several memories, add --memory: {listing(memories)}")
    if name is None:
        return next(iter(memories))
    require_known(name, memories, f"{owner} has no memory", "memories")
    return name


def replace(file: Path, memory: str, runs: Iterable[InitialRun], *, merge: bool) -> None:
    """Stores values in a memory of the file. Without `merge`, all its other values become 0.

    Raises `OSError` for a file that can't be used, or is that of a log, and `OutOfRange`.
    """
    areas = contents(file)[memory]
    sizes = {area: len(kept.values) for area, kept in areas.items()}
    numbers = {area: area.removeprefix(FILE) for area in areas if area.startswith(FILE)}
    files = {int(number): sizes.pop(area) for area, number in numbers.items()}
    spans: Any = {area: (areas[area].start, size) for area, size in sizes.items()}
    made = _core.Memory(**spans, files=files)
    opened = _core.MemoryFile(str(file), [(memory, made)], 1.0)
    try:
        if opened.note is not None:
            # A node would refuse contents that are not those of its note.
            raise OSError(
                f"{file}: the file is of a log, which alone changes it. Write to a node that runs,"
                " or export the file, and begin a new log with the values as 'initial'"
            )
        writes: list[tuple[str, int, Sequence[int]]] = []
        if not merge:
            zeros = ((area, kept.start, [0] * len(kept.values)) for area, kept in areas.items())
            writes += zeros
        writes += ((run.area, run.address, run.values) for run in runs)
        if writes:
            made.write_many(writes)
        opened.start()
    finally:
        opened.stop()


def release(file: Path, memory: str) -> None:
    """Deletes what a memory of the file has set aside. Raises `OSError`."""
    _core.release_memory_file(str(file), memory)


def kind_of(file: Path) -> str:
    """The suffix of a file of `initial`. Raises `click.UsageError` for another one."""
    kind = file.suffix.lower()
    if kind not in KINDS:
        raise click.UsageError(f"found {file.name}, allowed: a file with one of {listing(KINDS)}")
    return kind


def written(areas: Mapping[Area, KeptArea], kind: str, *, zeros: bool) -> str:
    """The values as text in the format of `initial`."""
    lines = _csv_lines if kind == ".csv" else _yaml_lines
    return "".join(f"{line}\n" for line in lines(areas, zeros=zeros))


def write(file: Path, text: str) -> None:
    """Writes a file, or ends the program: a failed export leaves the one before as it was."""
    try:
        whole_files.replace(file, text.encode())
    except OSError as error:
        fail(f"{file}: {error.strerror or error}", ExitCode.WRONG)


def _csv_lines(areas: Mapping[Area, KeptArea], *, zeros: bool) -> Iterator[str]:
    """Lines of area,address,value."""
    yield "area,address,value"
    for area, kept in areas.items():
        for address, value in kept.cells(zeros=zeros):
            yield f"{area},{address},{value}"


def _yaml_lines(areas: Mapping[Area, KeptArea], *, zeros: bool) -> Iterator[str]:
    """Areas with runs of values: `ADDRESS: [VALUE, …]`."""
    for area, kept in areas.items():
        yield f"{area}:" if any(kept.values) or zeros else f"{area}: {{}}"
        for first, values in runs_of(kept.cells(zeros=zeros)):
            yield f"  {first}: {values}"


def _values(area: Area, size: int, data: bytes) -> list[int]:
    if area in BIT_AREAS:
        return [data[index // 8] >> index % 8 & 1 for index in range(size)]
    return [int.from_bytes(data[index : index + 2], "big") for index in range(0, 2 * size, 2)]
