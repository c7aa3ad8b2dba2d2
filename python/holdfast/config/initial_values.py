"""Reads initial values of a memory from a file, and checks them like any write.

CSV has one line `area,address,value` per value. YAML has `area: {address: value}`, where a list of
values starts at that address. Use CSV for large sets: it loads much faster.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from holdfast.config.text import yaml_document
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError, Problem
from holdfast.protocol import ADDRESSES, MAX_WORD
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import extent, listing
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

KINDS = (".csv", ".yaml", ".yml")
MAX_CSV_BYTES = 8 << 20
"""The size limit of a CSV file. All values of four areas take less; `files` raise it."""

HEADER = ["area", "address", "value"]

Cell: TypeAlias = tuple[str, int]


class InitialRun(NamedTuple):
    """Consecutive values of one area, or of a file (`file:4`), from `address` on."""

    area: str
    address: int
    values: tuple[int, ...]


class _Given(NamedTuple):
    """One value of a file, not yet checked; `key` is its path in a YAML file."""

    line: int
    column: int
    key: str
    area: object
    address: object
    value: object


def read(path: Path, file: str, areas: Mapping[str, range | None]) -> bytes:
    """Reads a file of initial values; messages call it `file`. Raises `ConfigError`.

    All values of `areas`, each in a line of its own, are not too large.
    """
    if path.suffix.lower() == ".csv":
        least, lines = MAX_CSV_BYTES, [f"{area},65535,65535\r\n" for area in areas]
    else:
        least, lines = yaml_document.MAX_BYTES, ["  65535: [65535]\r\n"] * len(areas)
    counts = _counts(areas)
    # One more line of each area, for its name.
    most = sum(len(line) * (count + 1) for line, count in zip(lines, counts, strict=True))
    return yaml_document.read_bytes(path, file, max(least, most))


def parse(
    content: bytes, file: str, areas: Mapping[str, range | None]
) -> tuple[tuple[InitialRun, ...], list[Problem]]:
    """Returns the values of a file as runs, and the problems of the file.

    `areas` are the areas and files of the memory; addresses of `None` allow any address.
    """
    judge = _Judge(file, areas)
    try:
        text = yaml_document.decoded(content, file, "YAML or CSV")
        for given in (
            _csv(text, judge) if Path(file).suffix.lower() == ".csv" else _yaml(text, judge)
        ):
            judge.take(given)
    except ConfigError as error:
        judge.problems += error.problems
    return tuple(judge.runs()), judge.problems


def sealed(runs: Iterable[InitialRun], gate: Cell) -> tuple[InitialRun, ...]:
    """The values with 0 in the gate bit of the seal: what was exported may be of an open one."""
    area, address = gate
    return tuple(
        run._replace(values=(*run.values[:at], 0, *run.values[at + 1 :]))
        if run.area == area and 0 <= (at := address - run.address) < len(run.values)
        else run
        for run in runs
    )


def runs_of(cells: Iterable[tuple[int, int]]) -> Iterator[tuple[int, list[int]]]:
    """The values of addresses in their order, as runs: a first address, and values from there."""
    first, values = 0, list[int]()
    for address, value in cells:
        if values and address != first + len(values):
            yield first, values
            values = []
        first = first if values else address
        values.append(value)
    if values:
        yield first, values


def _counts(areas: Mapping[str, range | None]) -> list[int]:
    return [len(addresses or range(ADDRESSES)) for addresses in areas.values()]


@dataclass
class _Judge:
    """Checks values one by one and keeps the valid ones."""

    file: str
    areas: Mapping[str, range | None]
    problems: list[Problem] = field(default_factory=list)
    kept: dict[str, dict[int, tuple[int, int]]] = field(default_factory=dict)

    def refuse(self, line: int, column: int | None, key: str, message: str) -> None:
        """Adds a problem of this file."""
        self.problems.append(Problem(self.file, line, column, key, message))

    def take(self, given: _Given) -> None:
        """Keeps a value and its line, or adds a problem."""
        try:
            area, address, value = self._judged(given)
        except ValueError as error:
            self.refuse(given.line, given.column, given.key, str(error))
        else:
            self.kept.setdefault(area, {})[address] = (value, given.line)

    def _judged(self, given: _Given) -> tuple[str, int, int]:
        area = next((area for area in self.areas if area == given.area), None)
        if area is None:
            lacking = ", which this memory does not have" if given.area in AREAS else ""
            near = "" if lacking else suggestion(given.area, AREAS)
            allowed = f"allowed: {listing(self.areas)}{near}"
            raise ValueError(f"found area {show(given.area)}{lacking}, {allowed}")
        addresses, address = self.areas[area] or range(ADDRESSES), given.address
        if not isinstance(address, int) or address not in addresses:
            allowed = f"allowed in {area}: {extent(addresses)}"
            raise ValueError(f"found address {show(address)}, {allowed}")
        value = self._value(area, given.value)
        if address in self.kept.get(area, {}):
            line = self.kept[area][address][1]
            raise ValueError(f"duplicate {area} {address}, first in line {line}")
        return area, address, value

    def _value(self, area: str, value: object) -> int:
        most, to = (1, "or") if area in BIT_AREAS else (MAX_WORD, "to")
        if type(value) is not int or not 0 <= value <= most:
            raise ValueError(f"found {show(value)}, allowed in {area}: 0 {to} {most}")
        return value

    def runs(self) -> Iterator[InitialRun]:
        """The kept values as runs, in the order of their addresses."""
        for area, cells in self.kept.items():
            kept = sorted((address, value) for address, (value, _) in cells.items())
            for first, values in runs_of(kept):
                yield InitialRun(area, first, tuple(values))


def _csv(text: str, judge: _Judge) -> Iterator[_Given]:
    header_may_come = True
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        fields = [part.strip() for part in line.split(",")]
        is_header = header_may_come and [part.lower() for part in fields] == HEADER
        header_may_come = False
        if is_header:
            continue
        if len(fields) != len(HEADER):
            judge.refuse(number, 1, "", f"found {show(line)}, allowed: area,address,value")
            continue
        area, address, value = fields
        yield _Given(number, 1, "", area, _integer(address), _integer(value))


def _integer(text: str) -> int | str:
    return int(text) if re.fullmatch("-?[0-9]{1,10}", text, re.ASCII) else text


def _yaml(text: str, judge: _Judge) -> Iterator[_Given]:
    # Each value in a list of its own, with its address, and the names of the areas.
    most = sum(3 * count + 2 for count in _counts(judge.areas))
    document, problems = yaml_document.parse(text, judge.file, room=most + 1)
    judge.problems += problems
    if document.data is None:
        return
    if not isinstance(document.data, dict):
        judge.refuse(1, 1, "", f"found {show(document.data)}, allowed: area: {{address: value}}")
        return
    for area, cells in document.data.items():
        if not isinstance(cells, dict):
            place = document.place((area,), of_key=True)
            message = f"found {show(cells)}, allowed: {{address: value}}"
            judge.refuse(place.line, place.column, document.spell((area,)), message)
            continue
        for address, values in cells.items():
            yield from _cells(document, area, address, values)


def _cells(
    document: yaml_document.Document,
    area: yaml_document.Key,
    address: yaml_document.Key,
    values: object,
) -> Iterator[_Given]:
    many = isinstance(values, list) and isinstance(address, int)
    for index, value in enumerate(values if many and isinstance(values, list) else [values]):
        path = (area, address, index) if many else (area, address)
        place = document.place(path)
        at = address + index if isinstance(address, int) else address
        yield _Given(place.line, place.column, document.spell(path), area, at, value)
